"""The check of `readable-secret`: a secret in a file that every user can read."""

from __future__ import annotations

import stat
from collections.abc import Iterator

from mosaico_ingest.lint.check import Check, Job, Problem


def check(job: Job) -> Iterator[Problem]:
    """Report a literal API key in a file that every user can read."""
    key = job.source.at(("target", "api_key"))
    if not isinstance(key, str) or "${" in key or job.file is None:
        return
    mode = job.file.stat().st_mode
    if mode & stat.S_IROTH:
        message = f"every user of this machine can read the API key (file mode {stat.S_IMODE(mode):o})"
        yield Problem(message, job.key_span("target", "api_key"), f"run chmod 600 {job.file}")


CHECK = Check("readable-secret", job=check, reads_files=True)
