"""`unencrypted-key`: a key sent without encryption.

Without TLS the API key crosses the network as plain text with every call.

Bad:
    bag: {path: data/run.mcap}
    target: {host: mosaico.example.org, api_key: "${MOSAICO_API_KEY:-}"}

Good:
    bag: {path: data/run.mcap}
    target: {host: mosaico.example.org, api_key: "${MOSAICO_API_KEY:-}", tls: true}
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Problem, Rule

_HERE = {"localhost", "127.0.0.1", "::1"}


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem if a key goes to another machine and TLS is off."""
    target = job.manifest.target
    encrypted = target.tls or job.given("target", "tls") or target.tls_cert is not None
    if target.api_key is not None and job.known(target.host) and target.host not in _HERE and not encrypted:
        span = job.key_span("target", "api_key")
        yield Problem(f"the key is sent to {target.host} without encryption", span, "set target.tls: true")


RULE = Rule("ING227", __name__, Severity.WARNING, __doc__, job=check)
