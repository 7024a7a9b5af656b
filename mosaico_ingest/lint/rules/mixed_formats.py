"""The rule `mixed-formats`: splits of one recording in different formats."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from mosaico_ingest.lint.job import Job, recording_paths
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for the first part whose suffix differs from the first one's."""
    parts = [(place, path, Path(path).suffix.lower()) for place, path in recording_paths(job)]
    kinds = [(place, path, suffix) for place, path, suffix in parts if suffix in {".bag", ".db3", ".mcap"}]
    for place, path, suffix in kinds[1:]:
        if suffix != kinds[0][2]:
            message = f"{path} is another format than {kinds[0][1]}"
            yield Problem(message, job.source.span(place), "make them two jobs")
            return


CHECK = Check("mixed-formats", job=check)
