"""The status of a job's recordings: compare each with the provenance of its sequence."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from enum import Enum

from msgspec import Struct

from mosaico_ingest.errors import IngestError, SequenceExists
from mosaico_ingest.job.model import Job
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.pipeline.known import with_known
from mosaico_ingest.pipeline.provenance import (
    add_doubtful_digests,
    decide_skip,
    read_provenance,
    stored_provenance,
)
from mosaico_ingest.pipeline.run import make_plan
from mosaico_ingest.pipeline.task import Task


class Status(str, Enum):
    """What a run with `if_exists: skip` would do with a recording."""

    DONE = "done"
    """Skip it: the same content is stored, ingested by the same job."""
    NEW = "new"
    """Ingest it: there is no sequence of its name."""
    CHANGED = "changed"
    """Fail: the sequence was made from other content, or by another job. If the recording has grown: replace it."""
    FAILED = "failed"
    """Replace it: an earlier run of the same content ended with an error."""
    UNREADABLE = "unreadable"
    """Fail: the recording cannot be opened, or the job does not fit it."""


class RecordingStatus(Struct, frozen=True):
    """The status of one recording."""

    sequence: str
    files: tuple[str, ...]
    status: Status
    reason: str = ""
    """The reason of a status other than `done` or `new`."""


def recording_statuses(jobs: Iterable[Job], *, verify: bool = False) -> Iterator[RecordingStatus]:
    """Yield the status of each recording; read-only.

    Stored recordings whose files and job have not changed are recognized by their fingerprints; with `verify`, every
    recording is opened and its content is compared.
    """
    for job, is_known in ((job, False) for job in jobs) if verify else with_known(jobs):
        status, reason = (Status.DONE, "") if is_known else _status(job)
        yield RecordingStatus(job.sequence.name, tuple(map(str, job.paths)), status, reason)


def _status(job: Job) -> tuple[Status, str]:
    try:
        plan = make_plan(Task(job))
        stored = stored_provenance(plan.destination, plan.sequence.name)
        if stored is None:
            return Status.NEW, ""
        provenance = add_doubtful_digests(read_provenance(plan), plan.files, stored)
        decision = decide_skip(provenance, stored, files=plan.files, sequence=plan.sequence.name)
    except SequenceExists as error:
        return Status.CHANGED, error.what
    except IngestError as error:
        return Status.UNREADABLE, str(error)
    if decision is IfExists.REPLACE and stored.complete:
        return Status.CHANGED, "the recording has grown since it was ingested"
    if decision is IfExists.REPLACE:
        return Status.FAILED, "the run that wrote it ended with an error"
    return Status.DONE, ""
