"""`newer-version`: a manifest for a newer tool.

Its language has keys this tool does not know, or keys that mean something else by now.

Bad:
    version: 2
    bag: {path: data/run.mcap}

Good:
    version: 1
    bag: {path: data/run.mcap}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING109", __name__, Severity.ERROR, __doc__)
