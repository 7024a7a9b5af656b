"""The check of `delete-permission`: `session: delete` with a key that may not delete."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.job.values import SessionLevelErrorPolicy
from mosaico_ingest.lint.check import Check, Job, Problem


def check(job: Job) -> Iterator[Problem]:
    """Report `session: delete` if the name of the API key's variable suggests write permission only."""
    key = job.source.at(("target", "api_key"))
    if job.manifest.on_error.session is not SessionLevelErrorPolicy.Delete or not isinstance(key, str):
        return
    words = key.lower()
    if "write" in words and "delete" not in words and "manage" not in words:
        message = (
            "session: delete requires a key with delete permission, and this key seems to allow writing only"
        )
        yield Problem(message, job.span("on_error", "session"), "set session: report, or use another key")


CHECK = Check("delete-permission", job=check)
