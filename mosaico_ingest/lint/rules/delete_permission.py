"""`delete-permission`: deleting with a key that may only write.

`on_error.session: delete` removes what a failed run has written. On a server this needs a key with delete permission;
a key with write permission leaves the broken session behind.

Bad:
    bag: {path: data/run.mcap}
    on_error: {session: delete}
    target:
      host: localhost
      api_key: ${WRITE_KEY:-}

Good:
    bag: {path: data/run.mcap}
    on_error: {session: report}
    target:
      host: localhost
      api_key: ${MOSAICO_KEY:-}
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.job.values import SessionLevelErrorPolicy
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Problem, Rule


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem if a server's session is to be deleted and the key is said to be one for writing."""
    written = job.source.at(("target", "api_key"))
    if job.manifest.on_error.session is not SessionLevelErrorPolicy.Delete or not isinstance(written, str):
        return
    words = written.lower().replace("_", " ")
    if "write" in words and not any(word in words for word in ("delete", "manage")):
        message = "session: delete needs a key with delete permission, and this one is for writing"
        yield Problem(message, job.span("on_error", "session"), "say report, or use another key")


RULE = Rule("ING229", __name__, Severity.WARNING, __doc__, job=check)
