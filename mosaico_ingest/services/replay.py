"""This file says what becomes of the messages in a quarantine, and makes the configurations that ingest them."""

from __future__ import annotations

import sqlite3
import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from enum import Enum
from pathlib import Path

from msgspec import Struct

from mosaico_ingest.destinations.store.files import Lease
from mosaico_ingest.errors import ManifestError, NothingMatched, SinkUnavailable
from mosaico_ingest.findings import escape_undecodable, join_names
from mosaico_ingest.job.config import QuarantineSettings, ROSInjectionConfig, TimeRange
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
    config: ROSInjectionConfig


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


def replays(folder: Path, configs: Sequence[ROSInjectionConfig]) -> tuple[Replay, ...]:
    """Return what lies in a quarantine, each with the configuration of its sequence.

    Raises:
        NothingMatched: It is empty.
        ManifestError: None of the configurations is for a sequence that has messages there.
        BagError: A file there cannot be read.
    """
    known = {config.sequence_name: config for config in configs}
    return tuple(_replay(kept, known) for kept in find_quarantine_files(folder))


def _replay(kept: QuarantineFile, known: dict[str, ROSInjectionConfig]) -> Replay:
    if kept.sequence not in known:
        raise ManifestError(
            f"{kept.messages.name} belongs to the sequence {kept.sequence!r}, which the manifest does not make",
            where=next((config.where for config in known.values()), None),
            hint=f"it makes {join_names(known)}",
        )
    config = known[kept.sequence]
    return Replay(kept, _whereabouts(kept, config), _configuration(kept, config))


def _whereabouts(kept: QuarantineFile, config: ROSInjectionConfig) -> Whereabouts:
    """Ask the provenances of the sequence; a server keeps that of its first session only, and adds to no topic twice."""
    stored = stored_provenance(config.target, kept.sequence)
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


def _configuration(kept: QuarantineFile, config: ROSInjectionConfig) -> ROSInjectionConfig:
    """Return the configuration of a sequence for messages kept of it: all of them, added to what is there, or none.

    What fails again is kept again, however much: the copy that is there is put away.
    """
    folder = config.quarantine.path if config.quarantine else kept.messages.parent
    return replace(
        config,
        file_path=kept.messages,
        if_exists=IfExists.APPEND,
        on_error=SessionLevelErrorPolicy.Delete,
        topics_on_error=TopicLevelErrorPolicy.Raise,
        topics=(),
        every={},
        time_range=TimeRange(),
        quarantine=QuarantineSettings(folder, systematic=sys.maxsize),
        plan_digest=None,
    )
