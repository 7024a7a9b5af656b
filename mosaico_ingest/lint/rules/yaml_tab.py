r"""`yaml-tab`: a tab where YAML is indented.

Editors show a tab as two, four or eight blanks; YAML therefore allows none in indentation.

Bad:
    bag:
    \tpath: data/run.mcap

Good:
    bag:
      path: data/run.mcap
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING002", __name__, Severity.ERROR, __doc__)
