"""`yaml-boolean`: a word that is a boolean to some readers.

YAML 1.1 reads `on`, `off`, `yes` and `no` as booleans, YAML 1.2 as text. A country code `NO` has become
`false` that way more than once.

Bad:
    bag: {path: data/run.mcap}
    sequence:
      metadata: {country: NO}

Good:
    bag: {path: data/run.mcap}
    sequence:
      metadata: {country: "NO"}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING007", __name__, Severity.ERROR, __doc__)
