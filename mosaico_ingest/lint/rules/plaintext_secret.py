"""`plaintext-secret`: a key written into a manifest.

Manifests are committed, copied and mailed. Whoever has one has the key.

Bad:
    bag: {path: data/run.mcap}
    target: {host: localhost, api_key: not_a_real_key}

Good:
    bag: {path: data/run.mcap}
    target: {host: localhost, api_key: "${MOSAICO_API_KEY:-}"}
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from mosaico_ingest.diagnostics import Severity
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.places import values_below
from mosaico_ingest.lint.rule import Problem, Rule


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem if the key is no variable, and for every API key that stands elsewhere."""
    remedy = "write ${MOSAICO_API_KEY} and set it in the environment"
    for path in values_below(job.source.value, ()):
        value = job.source.at(path)
        is_key = path == ("target", "api_key") and isinstance(value, str) and "${" not in value
        if is_key or (isinstance(value, str) and _KEY.search(value)):
            yield Problem("an API key can be read here", job.source.span(path), remedy)


_KEY = re.compile(r"msco_[a-z0-9]{32}_[0-9a-f]{8}")


RULE = Rule("ING226", __name__, Severity.ERROR, __doc__, job=check)
