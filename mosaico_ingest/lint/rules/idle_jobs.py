"""The rule `idle-jobs`: parallel jobs for a single recording."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.job import Job, is_glob
from mosaico_ingest.lint.rule import Check, Problem
from mosaico_ingest.remote import without_options


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem if there are more jobs than one and the path is no glob."""
    path = job.manifest.bag.path
    if job.manifest.run.jobs > 1 and not (
        isinstance(path, str) and (is_glob(without_options(path)) or not job.known(path))
    ):
        yield Problem("there is one recording, so one job", job.span("run", "jobs"), "remove it")


CHECK = Check("idle-jobs", job=check)
