"""`duplicate-key`: a key that is given twice.

Most readers take the last one without a word, so that half of what was written has no effect.

Bad:
    bag: {path: data/run.mcap}
    sequence:
      name: run_01
      name: run_02

Good:
    bag: {path: data/run.mcap}
    sequence:
      name: run_02
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING015", __name__, Severity.ERROR, __doc__)
