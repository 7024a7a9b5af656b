"""`yaml-alias`: an unquoted `*`, which starts a YAML alias.

`*camera_info` stands for what an anchor `&camera_info` names. Where there is none, a glob was meant.

Bad:
    bag: {path: data/run.mcap}
    topics:
      - */camera_info

Good:
    bag: {path: data/run.mcap}
    topics:
      - "*/camera_info"
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING004", __name__, Severity.ERROR, __doc__)
