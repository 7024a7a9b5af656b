"""`unused-ignore`: an ignore comment that silences nothing.

What it was about has been mended, or has another name; it would silence the next mistake instead.

Bad:
    bag: {path: data/run.mcap}
    sequence: {name: run_01}  # ingest: ignore[yaml-boolean]

Good:
    bag: {path: data/run.mcap}
    sequence: {metadata: {side: on}}  # ingest: ignore[yaml-boolean]
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING018", __name__, Severity.WARNING, __doc__)
