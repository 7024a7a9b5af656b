"""The status of recordings and of quarantined messages in the destination, and the jobs that replay the latter."""

from __future__ import annotations

import sqlite3
import sys
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from enum import Enum
from pathlib import Path

from msgspec import Struct

from mosaico_ingest.destinations.store.files import Lease
from mosaico_ingest.errors import IngestError, ManifestError, NothingMatched, SequenceExists, SinkUnavailable
from mosaico_ingest.findings import escape_undecodable, join_names
from mosaico_ingest.job.model import ErrorPolicy, Job, QuarantineSettings, TimeRange, TopicSettings
from mosaico_ingest.job.values import IfExists, SessionLevelErrorPolicy, TopicLevelErrorPolicy
from mosaico_ingest.pipeline.provenance import (
    add_doubtful_digests,
    content_digest,
    decide_skip,
    read_provenance,
    stored_provenance,
    with_known,
)
from mosaico_ingest.pipeline.rejections import QuarantineFile, find_quarantine_files
from mosaico_ingest.pipeline.run import make_plan
from mosaico_ingest.pipeline.task import Task

_LOCK = ".replay.lock"


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


class ReplayState(Enum):
    """The state of the messages of a quarantine file in the destination."""

    WAITING = "waiting"
    """The sequence has the run that quarantined the messages, but not the messages."""
    STORED = "stored"
    """The sequence has the messages: a replay was stopped before it could rename the file."""
    ORPHANED = "orphaned"
    """The sequence does not have the run that quarantined the messages: it was discarded, replaced or removed."""


class Replay(Struct, frozen=True):
    """A quarantine file, its state in the destination, and the job that appends its messages."""

    file: QuarantineFile
    state: ReplayState
    job: Job


@contextmanager
def lock_quarantine(folder: Path) -> Generator[None, None, None]:
    """Hold the lock of a quarantine, so that no two replays append the same messages.

    Raises:
        NothingMatched: The folder does not exist.
        SinkUnavailable: Another replay holds the lock.
    """
    if not folder.is_dir():
        raise NothingMatched(
            "the folder does not exist", where=str(folder), hint="name the folder of a quarantine"
        )
    lock = folder / _LOCK
    try:
        lease = Lease(lock)
    except sqlite3.OperationalError as error:
        busy = "locked" in str(error)
        what = "another replay is running" if busy else f"cannot be written: {error}"
        raise SinkUnavailable(what, where=str(folder), hint="wait until it ends" if busy else None) from error
    try:
        yield
    finally:
        with suppress(OSError):
            lock.unlink()
        lease.release()


def find_replays(folder: Path, jobs: Sequence[Job]) -> tuple[Replay, ...]:
    """Return the files of a quarantine, each with the job that appends its messages to its sequence.

    Raises:
        NothingMatched: The quarantine is empty.
        ManifestError: A file belongs to a sequence of none of the jobs.
        BagError: A file cannot be read.
    """
    by_sequence = {job.sequence.name: job for job in jobs}
    return tuple(_replay(file, by_sequence) for file in find_quarantine_files(folder))


def _replay(file: QuarantineFile, by_sequence: dict[str, Job]) -> Replay:
    if file.sequence not in by_sequence:
        raise ManifestError(
            f"{file.messages.name} belongs to the sequence {file.sequence!r}, which the manifest does not define",
            where=next((job.origin.file for job in by_sequence.values()), None),
            hint=f"the manifest defines {join_names(by_sequence)}",
        )
    job = by_sequence[file.sequence]
    return Replay(file, _state(file, job), _replay_job(file, job))


def _state(file: QuarantineFile, job: Job) -> ReplayState:
    """Return the state of a file according to the provenance of its sequence.

    A server keeps only the record of the first session, so there a file is never orphaned while the sequence exists.
    """
    stored = stored_provenance(job.destination, file.sequence)
    if stored is None:
        return ReplayState.ORPHANED
    name = escape_undecodable(file.messages.name)
    sources = {(source.name, source.content) for record in stored.records for source in record.sources}
    if (name, content_digest(file.messages)) in sources:
        return ReplayState.STORED
    records = stored.records if stored.has_all_sessions else ()
    if records and all(record.quarantine != name for record in records):
        return ReplayState.ORPHANED
    return ReplayState.WAITING


def _replay_job(file: QuarantineFile, job: Job) -> Job:
    """Return the job that appends quarantined messages to their sequence: all of them, or none.

    The contracts of the job describe recordings, so they do not apply to these messages.
    Messages that fail again are quarantined again without a limit, because the current copy is set aside.
    """
    folder = job.quarantine.path if job.quarantine else str(file.messages.parent)
    return job.replace(
        bag=job.bag.replace(path=str(file.messages), time=TimeRange()),
        paths=(file.messages,),
        sequence=job.sequence.replace(if_exists=IfExists.APPEND, metadata_from=None, metadata_schema=None),
        on_error=ErrorPolicy(
            session=SessionLevelErrorPolicy.Delete,
            topic=TopicLevelErrorPolicy.Raise,
            message=job.on_error.message,
        ),
        topics=(),
        topic_settings={
            topic: TopicSettings.model_construct(
                **{key: getattr(settings, key) for key in settings.model_fields_set - {"every"}}
            )
            for topic, settings in job.topic_settings.items()
        },
        expect=None,
        definitions=None,
        lock=None,
        quarantine=QuarantineSettings(path=folder).replace(systematic=sys.maxsize),
    )
