"""The check of `unencrypted-key`: an API key that is sent without encryption."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.check import Check, Job, Problem

_LOCAL_HOSTS = frozenset({"localhost", "127.0.0.1", "::1"})


def check(job: Job) -> Iterator[Problem]:
    """Report an API key for another machine if TLS is off."""
    target = job.manifest.target
    is_encrypted = target.tls or job.has("target", "tls") or target.tls_cert is not None
    if target.api_key is None or is_encrypted or not job.is_expanded(target.host):
        return
    if target.host not in _LOCAL_HOSTS:
        message = f"the API key is sent to {target.host} without encryption"
        yield Problem(message, job.key_span("target", "api_key"), "set target.tls: true")


CHECK = Check("unencrypted-key", job=check)
