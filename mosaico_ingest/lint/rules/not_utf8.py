"""`not-utf8`: a file that is not UTF-8.

YAML and `.msg` files are UTF-8. Other encodings turn names into other names on another machine.
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING017", __name__, Severity.ERROR, __doc__)
