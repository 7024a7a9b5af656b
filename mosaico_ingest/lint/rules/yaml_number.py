"""`yaml-number`: digits that are a number to some readers.

`010` is eight, ten or text, `1_000` a number or text, `12:30` a time or the number 750: it depends on the reader.

Bad:
    bag: {path: data/run.mcap}
    sequence:
      metadata: {vehicle: 007}

Good:
    bag: {path: data/run.mcap}
    sequence:
      metadata: {vehicle: "007"}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING008", __name__, Severity.ERROR, __doc__)
