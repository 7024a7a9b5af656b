"""`unset-variable`: a variable of the environment that is not set.

An empty text in its place would do something else than what is written. `${VAR:-default}` names a default,
`ingest lint --no-env` does not look at the environment at all.

Bad:
    bag: {path: data/run.mcap}
    target:
      host: ${UNSET_HOST:?the server's name}

Good:
    bag: {path: data/run.mcap}
    target:
      host: ${UNSET_HOST:-mosaico.example.org}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING110", __name__, Severity.ERROR, __doc__)
