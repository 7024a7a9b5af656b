"""Groups of recordings that are committed together."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from mosaico_ingest.destinations.base import destination_of
from mosaico_ingest.errors import IngestError

if TYPE_CHECKING:
    from mosaico_ingest.job.model import Job
    from mosaico_ingest.job.values import Target
    from mosaico_ingest.pipeline.task import Task
    from mosaico_ingest.remote import AnyPath

SMALL_BYTES = 4 << 20
"""Maximum size of a recording that joins others; a larger one might keep them waiting for their commit."""
_MAX_S = 0.25
"""Seconds after which no recording joins a group."""


def commit_groups(tasks: Iterable[Task]) -> Iterator[tuple[Target, Iterator[Task]]]:
    """Yield the destination and the tasks of each group; a group ends while its tasks run, by their number or by time.

    The recordings of a group have the same destination, and none depends on what another one stores.
    """
    remaining = iter(tasks)
    following = next(remaining, None)

    def group(task: Task, destination: Target) -> Iterator[Task]:
        nonlocal following
        names = set[str]()
        end_s = time.monotonic() + _MAX_S
        limit = destination_of(destination).max_commits
        while True:
            names.add(task.job.sequence.name)
            yield task
            following = next(remaining, None)
            if following is None or len(names) == limit or time.monotonic() > end_s:
                return
            task, job = following, following.job
            if not may_join(job) or job.sequence.name in names or job.destination != destination:
                return

    while following is not None:
        destination = following.job.destination
        yield destination, group(following, destination)


def may_join(job: Job) -> bool:
    """Return whether a recording is small, and independent of the sequences that are stored before it."""
    if job.on_schema_change is not None or job.expect is not None:
        return False
    size = source_bytes(job)
    return size is not None and size <= SMALL_BYTES


def source_bytes(job: Job) -> int | None:
    """Return the size of the files of a recording, None if it is unknown."""
    with suppress(OSError, IngestError):
        sizes = [_size(path) for path in job.paths]
        return None if None in sizes else sum(size or 0 for size in sizes)
    return None


def _size(path: AnyPath) -> int | None:
    if not isinstance(path, Path):
        return None if path.listed is None else path.listed.st_size
    return sum(_size(part) or 0 for part in path.iterdir()) if path.is_dir() else path.stat().st_size
