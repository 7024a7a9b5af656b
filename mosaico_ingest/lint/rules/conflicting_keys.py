"""`conflicting-keys`: two keys that cannot both be meant.

A sequence goes to one place: a store or a server.

Bad:
    bag: {path: data/run.mcap}
    target: {store: ./mosaico, host: mosaico.example.org}

Good:
    bag: {path: data/run.mcap}
    target: {store: ./mosaico}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING108", __name__, Severity.ERROR, __doc__)
