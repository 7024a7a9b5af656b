"""`yaml-brace`: an unquoted `{`, which starts a YAML mapping.

`{stem}_raw` begins a mapping that is not one, and inside `{ … }` the braces of `${VAR}` do as well.

Bad:
    bag: {path: data/run.mcap}
    sequence:
      name: {stem}_raw

Good:
    bag: {path: data/run.mcap}
    sequence:
      name: "{stem}_raw"
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING006", __name__, Severity.ERROR, __doc__)
