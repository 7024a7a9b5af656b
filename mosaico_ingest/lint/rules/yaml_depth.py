"""`yaml-depth`: values that nest without end.

No manifest needs forty levels; a file that has them is damaged, or made to hurt its reader.

Bad:
    bag: {path: data/run.mcap}
    sequence: {metadata: {a: [[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[1]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]}}

Good:
    bag: {path: data/run.mcap}
    sequence: {metadata: {a: [[1]]}}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING012", __name__, Severity.ERROR, __doc__)
