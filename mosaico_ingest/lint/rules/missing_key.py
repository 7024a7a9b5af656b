"""`missing-key`: a key that must be there and is not.

Some things have no sensible default, a recording least of all.

Bad:
    sequence: {name: run_01}

Good:
    bag: {path: data/run.mcap}
    sequence: {name: run_01}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING103", __name__, Severity.ERROR, __doc__)
