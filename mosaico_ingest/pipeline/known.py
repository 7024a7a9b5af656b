"""Recordings that are stored already: recognized by their fingerprints, with one catalog query for many recordings."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import compress, islice
from pathlib import Path
from typing import TypeVar

from msgspec import structs

from mosaico_ingest.destinations.base import ExistingSequence, destination_of
from mosaico_ingest.job.model import Job
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.pipeline.fingerprint import fingerprint
from mosaico_ingest.pipeline.provenance import StoredProvenance
from mosaico_ingest.pipeline.task import Task

_FIRST_BATCH, _MAX_BATCH = 8, 256
"""Number of recordings of the first and of later catalog queries: the first recording of a run starts early."""
_T = TypeVar("_T")


def mark_known(
    tasks: Iterable[Task], is_finished: Callable[[str, str], bool] | None = None
) -> Iterator[Task]:
    """Yield the tasks, and mark a task as known if its recording is stored, complete and unchanged and may be skipped.

    It may be skipped with `if_exists: skip`. In a run that continues another one, `is_finished` returns whether that run
    reported a sequence and destination as stored. A recording may then also be skipped if it was, and with
    `if_exists: append`: the run may have been killed before it reported the rows, which would be stored twice.
    """

    def may_be_skipped(task: Task) -> bool:
        job = task.job
        if task.plan_digest is not None or task.dry_run:
            return False
        if job.sequence.if_exists is IfExists.SKIP or is_finished is None:
            return job.sequence.if_exists is IfExists.SKIP
        return job.sequence.if_exists is IfExists.APPEND or is_finished(
            job.sequence.name, destination_of(job.destination).describe()
        )

    for batch in _batches(tasks):
        skippable = [may_be_skipped(task) for task in batch]
        is_known = iter(known_recordings([task.job for task in compress(batch, skippable)]))
        for task, is_skippable in zip(batch, skippable, strict=True):
            yield structs.replace(task, known=True) if is_skippable and next(is_known) else task


def with_known(jobs: Iterable[Job]) -> Iterator[tuple[Job, bool]]:
    """Yield each job, and whether its recording is stored, complete and unchanged."""
    for batch in _batches(jobs):
        yield from zip(batch, known_recordings(batch), strict=True)


def known_recordings(jobs: Sequence[Job]) -> list[bool]:
    """Return for each job whether its recording is stored, complete and unchanged, according to its fingerprint.

    False means that the recording has to be opened and compared. Opening the recording raises errors; this function does not.
    """
    positions: dict[tuple[int, Path], list[int]] = defaultdict(list)
    for position, job in enumerate(jobs):
        # Targets are not hashable, and the jobs of a manifest share one.
        positions[id(job.target), job.folder].append(position)
    are_known = [False] * len(jobs)
    for group in positions.values():
        stored = _stored([jobs[position] for position in group])
        for position in group:
            existing = stored.get(jobs[position].sequence.name)
            if existing is not None and existing.complete:
                prints = {record.fingerprint for record in StoredProvenance.of(existing).records} - {None}
                are_known[position] = bool(prints) and fingerprint(jobs[position]) in prints
    return are_known


def _stored(jobs: Sequence[Job]) -> dict[str, ExistingSequence]:
    """Return the stored sequences of jobs with one destination; empty if it cannot be read."""
    try:
        return destination_of(jobs[0].destination).find_all([job.sequence.name for job in jobs])
    except Exception:  # noqa: BLE001 - destinations may be of other packages, and the run of the recording reports it
        return {}


def _batches(items: Iterable[_T]) -> Iterator[list[_T]]:
    iterator = iter(items)
    size = _FIRST_BATCH
    while batch := list(islice(iterator, size)):
        yield batch
        size = min(2 * size, _MAX_BATCH)
