"""This file says what becomes of the messages in a quarantine, and makes the configurations that ingest them."""

from __future__ import annotations

import sqlite3
import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from enum import Enum
from pathlib import Path

from msgspec import Struct

from mosaico_ingest.destinations.store.files import Lease
from mosaico_ingest.errors import ManifestError, NothingMatched, SinkUnavailable
from mosaico_ingest.findings import escape_undecodable, join_names
from mosaico_ingest.job.model import ErrorPolicy, Job, QuarantineSettings, TimeRange, TopicSettings
from mosaico_ingest.job.values import IfExists, SessionLevelErrorPolicy, TopicLevelErrorPolicy
from mosaico_ingest.pipeline.provenance import content_digest, stored_provenance
from mosaico_ingest.pipeline.quarantine import QuarantineFile, find_quarantine_files

__all__ = ["Replay", "Whereabouts", "alone", "replays"]

_LOCK = ".replay.lock"


class Whereabouts(Enum):
    """What the destination knows of kept messages."""

    WAITING = "waiting"
    """The run that kept them is part of the sequence, they are not."""
    STORED = "stored"
    """A replay has brought them in, and was stopped before it could say so here."""
    FORGOTTEN = "forgotten"
    """The run that kept them is not part of the sequence: it was stopped, or what it made was replaced or removed."""


class Replay(Struct, frozen=True):
    """QuarantineFile messages, what the destination knows of them, and the configuration that brings them in."""

    kept: QuarantineFile
    whereabouts: Whereabouts
    job: Job


@contextmanager
def alone(folder: Path) -> Generator[None, None, None]:
    """Hold a quarantine's lock, so that no two replays bring the same messages in.

    Raises:
        NothingMatched: There is no such folder.
        SinkUnavailable: Another replay holds it.
    """
    if not folder.is_dir():
        raise NothingMatched("there is no such folder", where=str(folder), hint="name a quarantine's folder")
    lock = folder / _LOCK
    try:
        lease = Lease(lock)
    except sqlite3.OperationalError as error:
        busy = "locked" in str(error)
        what = "another replay is at work here" if busy else f"cannot be written: {error}"
        raise SinkUnavailable(what, where=str(folder), hint="wait for it" if busy else None) from error
    try:
        yield
    finally:
        with suppress(OSError):
            lock.unlink()
        lease.release()


def replays(folder: Path, jobs: Sequence[Job]) -> tuple[Replay, ...]:
    """Return what lies in a quarantine, each with the configuration of its sequence.

    Raises:
        NothingMatched: It is empty.
        ManifestError: None of the configurations is for a sequence that has messages there.
        BagError: A file there cannot be read.
    """
    known = {job.sequence.name: job for job in jobs}
    return tuple(_replay(kept, known) for kept in find_quarantine_files(folder))


def _replay(kept: QuarantineFile, known: dict[str, Job]) -> Replay:
    if kept.sequence not in known:
        raise ManifestError(
            f"{kept.messages.name} belongs to the sequence {kept.sequence!r}, which the manifest does not make",
            where=next((job.origin.file for job in known.values()), None),
            hint=f"it makes {join_names(known)}",
        )
    job = known[kept.sequence]
    return Replay(kept, _whereabouts(kept, job), _replay_job(kept, job))


def _whereabouts(kept: QuarantineFile, job: Job) -> Whereabouts:
    """Ask the provenances of the sequence; a server keeps that of its first session only, and adds to no topic twice."""
    stored = stored_provenance(job.destination, kept.sequence)
    if stored is None:
        return Whereabouts.FORGOTTEN
    name = escape_undecodable(kept.messages.name)
    made_from = {(source.name, source.content) for known in stored.records for source in known.sources}
    if (name, content_digest(kept.messages)) in made_from:
        return Whereabouts.STORED
    provenances = stored.records if stored.has_all_sessions else ()
    if provenances and all(known.quarantine != name for known in provenances):
        return Whereabouts.FORGOTTEN
    return Whereabouts.WAITING


def _replay_job(kept: QuarantineFile, job: Job) -> Job:
    """Return the job that appends quarantined messages to their sequence: all of them, or none.

    Messages that fail again are quarantined again without a limit, because the current copy is set aside.
    """
    folder = job.quarantine.path if job.quarantine else str(kept.messages.parent)
    return job.replace(
        bag=job.bag.replace(path=str(kept.messages), time=TimeRange()),
        paths=(kept.messages,),
        sequence=job.sequence.replace(if_exists=IfExists.APPEND),
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
        quarantine=QuarantineSettings(path=folder).replace(systematic=sys.maxsize),
    )
