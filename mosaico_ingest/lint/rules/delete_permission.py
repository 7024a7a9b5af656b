"""The rule `delete-permission`: `session: delete` with a key that may not delete."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.job.values import SessionLevelErrorPolicy
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem if a server's session is to be deleted and the key is said to be one for writing."""
    written = job.source.at(("target", "api_key"))
    if job.manifest.on_error.session is not SessionLevelErrorPolicy.Delete or not isinstance(written, str):
        return
    words = written.lower().replace("_", " ")
    if "write" in words and not any(word in words for word in ("delete", "manage")):
        message = "session: delete needs a key with delete permission, and this one is for writing"
        yield Problem(message, job.span("on_error", "session"), "say report, or use another key")


CHECK = Check("delete-permission", job=check)
