"""`yaml-size`: more values than a manifest can have.

Aliases of aliases of aliases grow without the file growing: a few lines can stand for a billion values.

Bad:
    bag: {path: data/run.mcap}
    sequence:
      metadata:
        a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]
        b: &b [*a, *a, *a, *a, *a, *a, *a, *a, *a, *a]
        c: &c [*b, *b, *b, *b, *b, *b, *b, *b, *b, *b]
        d: &d [*c, *c, *c, *c, *c, *c, *c, *c, *c, *c]
        e: [*d, *d, *d, *d, *d, *d, *d, *d, *d, *d]

Good:
    bag: {path: data/run.mcap}
    sequence:
      metadata:
        a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]
        b: [*a, *a]
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING013", __name__, Severity.ERROR, __doc__)
