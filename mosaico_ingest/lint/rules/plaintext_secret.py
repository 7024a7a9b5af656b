"""The check of `plaintext-secret`: an API key or password written into a manifest."""

from __future__ import annotations

import re
from collections.abc import Iterator

from mosaico_ingest.findings import has_credentials
from mosaico_ingest.lint.check import Check, Job, Problem, value_paths_below

_API_KEY_PATH = ("target", "api_key")
_NONEMPTY_DEFAULT = re.compile(r"\$\{\w+:-[^}]")


def check(job: Job) -> Iterator[Problem]:
    """Report API keys anywhere in the manifest, credentials in URLs, and an `api_key` that is not a variable."""
    for path in value_paths_below(job.source.value, ()):
        value = job.source.at(path)
        if not isinstance(value, str):
            continue
        if has_credentials(value):
            message = "the manifest contains a secret"
        elif path == _API_KEY_PATH and ("${" not in value or _NONEMPTY_DEFAULT.search(value)):
            message = "the manifest contains an API key"
        else:
            continue
        hint = "use an environment variable, such as ${MOSAICO_API_KEY}, or the configuration of the storage client"
        yield Problem(message, job.source.span(path), hint)


CHECK = Check("plaintext-secret", job=check)
