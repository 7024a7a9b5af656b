"""`empty-manifest`: a manifest with nothing in it.

There is no job in an empty file, and a run of it must not look like a success.

Bad:
    # version: 1

Good:
    bag: {path: data/run.mcap}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING101", __name__, Severity.ERROR, __doc__)
