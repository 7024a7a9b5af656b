"""`ingest schema lock`: write the lock file of a manifest, or compare it with the recordings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from msgspec import Struct

from mosaico_ingest.adapters.bridge import ROSBridge
from mosaico_ingest.errors import ContractError
from mosaico_ingest.findings import Finding
from mosaico_ingest.job.model import Job
from mosaico_ingest.pipeline.compile import lock_path, read_lock_file
from mosaico_ingest.pipeline.definition_lock import (
    LockDifference,
    LockDocument,
    check_lock,
    lock_differences,
    lock_of,
    merge_locks,
    read_lock,
)
from mosaico_ingest.pipeline.opening import open_job
from mosaico_ingest.pipeline.planning import plan_recording
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.textfile import write_atomically


class WrittenLock(Struct, frozen=True):
    """A lock file that was written."""

    path: Path
    lock: LockDocument
    differences: tuple[LockDifference, ...]
    """The differences from the previous file; empty for a new file."""
    is_new: bool


def write_lock(manifest: Path, jobs: Sequence[Job]) -> WrittenLock:
    """Write the lock file of a manifest from the recordings of its jobs; an unchanged file is not written.

    Raises:
        ContractError: The recordings differ from each other.
        IngestError: A recording cannot be planned.
    """
    lock = merge_locks([(str(job.paths[0]), _lock_of(job)) for job in jobs])
    path = lock_path(manifest)
    is_new = not path.exists()
    differences: tuple[LockDifference, ...] = ()
    text = lock.text()
    if not is_new:
        previous = read_lock_file(manifest)
        if previous.text == text:
            return WrittenLock(path, lock, (), is_new)
        differences = lock_differences(read_lock(previous), lock)
    write_atomically(path, text)
    return WrittenLock(path, lock, differences, is_new)


def check_locked(manifest: Path, jobs: Sequence[Job]) -> int:
    """Compare the recordings of a manifest's jobs with its lock file; return the number of recordings.

    Raises:
        ContractError: A recording differs; `findings` has the differences of all recordings.
        ManifestError: The lock file does not exist or is invalid.
        IngestError: A recording cannot be planned.
    """
    file = read_lock_file(manifest)
    errors: list[ContractError] = []
    for job in jobs:
        try:
            check_lock(file, _lock_of(job), recording=str(job.paths[0]))
        except ContractError as error:  # noqa: PERF203 - each recording may differ
            errors.append(error)
    if errors:
        findings: dict[Finding, None] = {}
        for error in errors:
            findings.update(dict.fromkeys(error.findings))
        raise ContractError(
            f"{len(errors)} of {len(jobs)} recordings differ from {file.path}",
            hint=errors[0].hint,
            findings=tuple(findings),
        )
    return len(jobs)


def _lock_of(job: Job) -> LockDocument:
    """Return the lock of one recording; the contracts of the job are not checked."""
    sequence = job.sequence.replace(metadata_from=None, metadata_schema=None)
    bare = job.replace(definitions=None, lock=None, expect=None, sequence=sequence, on_schema_change=None)
    bridge = ROSBridge.for_job(bare)
    with open_job(bare) as (recording, resolver):
        plan = plan_recording(Task(bare), recording, bridge=bridge, resolver=resolver)
        return lock_of(plan, recording.connections)
