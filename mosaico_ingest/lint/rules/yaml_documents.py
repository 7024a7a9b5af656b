"""`yaml-documents`: a second document in one file.

After `---` another document begins. A file is one job; what follows would be left out without a word.

Bad:
    bag: {path: data/run_1.mcap}
    ---
    bag: {path: data/run_2.mcap}

Good:
    bag: {path: "data/run_*.mcap"}
    sequence: {name: "{stem}"}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING011", __name__, Severity.ERROR, __doc__)
