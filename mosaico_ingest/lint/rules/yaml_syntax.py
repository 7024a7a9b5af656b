"""`yaml-syntax`: text that is no YAML.

The file cannot be read beyond this place. The caret stands where the reader gave up, which is at or just
after the mistake.

Bad:
    bag: {path: data/run.mcap
    sequence: {name: run_01}

Good:
    bag: {path: data/run.mcap}
    sequence: {name: run_01}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING001", __name__, Severity.ERROR, __doc__)
