"""The rule `machine-path`: a path that exists only on one machine."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.job import Job, all_paths
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each path that is absolute as it is written."""
    for place, path in all_paths(job):
        written = job.source.at(place)
        if path.startswith(("/", "~")) and isinstance(written, str) and not written.startswith("$"):
            yield Problem(
                f"{path} is a path of one machine", job.source.span(place), "make it relative, or ${DATA}/…"
            )


CHECK = Check("machine-path", job=check)
