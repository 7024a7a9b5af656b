"""The rule `repeated-split`: a split that is listed twice."""

from __future__ import annotations

from collections.abc import Iterator
from os.path import normpath

from mosaico_ingest.lint.job import Job, recording_paths
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each part that is the same path as an earlier one."""
    seen: dict[str, int] = {}
    for place, path in recording_paths(job):
        normal = normpath(path)
        if normal in seen:
            message = f"{path} is already named in line {seen[normal]}"
            yield Problem(message, job.source.span(place), "remove one of the two")
        seen.setdefault(normal, job.source.span(place).line)


CHECK = Check("repeated-split", job=check)
