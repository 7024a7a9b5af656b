"""`empty-value`: a key without a value.

Nothing follows the colon. Whether nothing or the default was meant cannot be told.

Bad:
    bag: {path: data/run.mcap}
    adapters:

Good:
    bag: {path: data/run.mcap}
    adapters: {unmodeled: keep}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING107", __name__, Severity.ERROR, __doc__)
