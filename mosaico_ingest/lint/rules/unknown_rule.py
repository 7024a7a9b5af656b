"""`unknown-rule`: an ignore comment that names no rule.

It silences nothing, and seems to.

Bad:
    bag: {path: data/run.mcap}  # ingest: ignore[yaml-bolean]

Good:
    bag: {path: data/run.mcap}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING019", __name__, Severity.WARNING, __doc__)
