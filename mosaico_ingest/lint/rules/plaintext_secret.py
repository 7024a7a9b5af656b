"""The rule `plaintext-secret`: an API key or password written into a manifest."""

from __future__ import annotations

import re
from collections.abc import Iterator

from mosaico_ingest.lint.job import Job, values_below
from mosaico_ingest.lint.rule import Check, Problem


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


CHECK = Check("plaintext-secret", job=check)
