"""`adapter-cycle`: adapters that use each other without end.

An adapter that is used may use others, but none that leads back to itself.
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING412", __name__, Severity.ERROR, __doc__)
