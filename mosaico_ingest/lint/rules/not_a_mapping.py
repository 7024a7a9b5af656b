"""`not-a-mapping`: a manifest that is no mapping.

A job is a mapping of sections (`bag:`, `sequence:`, …) to what they say.

Bad:
    - bag
    - sequence

Good:
    bag: {path: data/run.mcap}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING102", __name__, Severity.ERROR, __doc__)
