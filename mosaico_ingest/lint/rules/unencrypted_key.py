"""The rule `unencrypted-key`: an API key that is sent without encryption."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Check, Problem

_HERE = {"localhost", "127.0.0.1", "::1"}


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem if a key goes to another machine and TLS is off."""
    target = job.manifest.target
    encrypted = target.tls or job.given("target", "tls") or target.tls_cert is not None
    if target.api_key is not None and job.known(target.host) and target.host not in _HERE and not encrypted:
        span = job.key_span("target", "api_key")
        yield Problem(f"the key is sent to {target.host} without encryption", span, "set target.tls: true")


CHECK = Check("unencrypted-key", job=check)
