"""`yaml-key`: a key that is no text.

Keys are names. A number, a boolean, an empty key or a list cannot be looked up by the name it seems to have.

Bad:
    bag: {path: data/run.mcap}
    sequence:
      metadata: {1: left, 2x: right}

Good:
    bag: {path: data/run.mcap}
    sequence:
      metadata: {"1": left, 2x: right}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING009", __name__, Severity.ERROR, __doc__)
