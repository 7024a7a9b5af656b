"""`plaintext-secret`: a key written into a manifest.

Manifests are committed, copied and mailed. Whoever has one has the key.

Bad:
    bag: {path: data/run.mcap}
    target: {host: localhost, api_key: not_a_real_key}

Bad:
    bag: {path: data/run.mcap}
    target: {host: localhost, api_key: "${MOSAICO_API_KEY:-not_a_real_key}"}

Good:
    bag: {path: data/run.mcap}
    target: {host: localhost, api_key: "${MOSAICO_API_KEY:-}"}
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.job import Job, values_below
from mosaico_ingest.lint.rule import Problem, Rule


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem if the key is no variable or has a default, and for every API key that stands elsewhere."""
    remedy = "write ${MOSAICO_API_KEY} and set it in the environment"
    for path in values_below(job.source.value, ()):
        value = job.source.at(path)
        if not isinstance(value, str):
            continue
        is_key = path == ("target", "api_key") and ("${" not in value or _DEFAULT.search(value))
        if is_key or _KEY.search(value):
            yield Problem("an API key can be read here", job.source.span(path), remedy)


_DEFAULT = re.compile(r"\$\{\w+:-[^}]")
_KEY = re.compile(r"msco_[a-z0-9]{32}_[0-9a-f]{8}")


RULE = Rule("ING226", __name__, Severity.ERROR, __doc__, job=check)
