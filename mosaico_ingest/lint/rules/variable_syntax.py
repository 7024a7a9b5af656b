"""`variable-syntax`: a `${` that begins no variable.

Variables are `${NAME}`, `${NAME:-default}` and `${NAME:?why}`; a dollar is `$$`.

Bad:
    bag: {path: "${DATA DIR}/run.mcap"}

Good:
    bag: {path: "${DATA_DIR:-data}/run.mcap"}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING111", __name__, Severity.ERROR, __doc__)
