"""`yaml-character`: a character YAML does not allow.

Control characters get into files by way of terminals and broken editors; one cannot see them, and YAML refuses them.
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING014", __name__, Severity.ERROR, __doc__)
