"""`unreadable-file`: a file that cannot be read.

It is not there, is a directory, or may not be read by this user.
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING016", __name__, Severity.ERROR, __doc__)
