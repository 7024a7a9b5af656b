"""The check of `idle-jobs`: parallel jobs for a single recording."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.job.values import is_glob
from mosaico_ingest.lint.check import Check, Job, Problem
from mosaico_ingest.remote import without_options


def check(job: Job) -> Iterator[Problem]:
    """Report `run.jobs` if the path names a single recording."""
    path = job.manifest.bag.path
    may_match_several = isinstance(path, str) and (
        is_glob(without_options(path)) or not job.is_expanded(path)
    )
    if job.manifest.run.jobs > 1 and not may_match_several:
        message = "a single recording cannot be ingested in parallel"
        yield Problem(message, job.span("run", "jobs"), "remove run.jobs")


CHECK = Check("idle-jobs", job=check)
