"""The embedded store as a destination."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Sequence
from contextlib import AbstractContextManager, closing
from os.path import normpath, relpath
from pathlib import Path
from typing import ClassVar, cast

from mosaico_ingest.destinations import (
    Destination,
    DestinationStatus,
    ExistingSequence,
    ExistingSession,
    ExistingTopic,
    FamilyTopic,
    Session,
    Sink,
)
from mosaico_ingest.destinations.store.model import SequenceInfo
from mosaico_ingest.destinations.store.session import StoreSession, StoreSink, commit_sessions
from mosaico_ingest.destinations.store.store import Store
from mosaico_ingest.errors import SinkError, Unreachable
from mosaico_ingest.job.values import Compression
from mosaico_ingest.remote import AnyPath, RemotePath

_MAX_COMMITS = 32
"""Maximum number of sessions in a transaction of the catalog; a store behind a URL has no transactions."""


class StoreDestination(Destination):
    """The store in a folder or behind a URL; a run creates it if it does not exist."""

    kind: ClassVar[str] = "store"
    can_attach: ClassVar[bool] = True
    can_amend: ClassVar[bool] = True

    def __init__(self, path: AnyPath, compression: Compression = Compression.FAST) -> None:
        self.path = path
        self.compression = compression
        self.max_commits = _MAX_COMMITS if isinstance(path, Path) else 1

    def describe(self, *, folder: Path | None = None) -> str:
        """Return the path or URL."""
        if isinstance(self.path, RemotePath):
            return str(self.path)
        return normpath(self.path) if folder is None else Path(relpath(self.path, folder)).as_posix()

    def inspect(self, sequence: str, *, connect: bool) -> DestinationStatus:  # noqa: ARG002 - a store is always read
        """Return the current state; a store behind a URL is read as well."""
        nearest = None if self.local_folder is None else _nearest_existing(self.local_folder)
        free_bytes = None if nearest is None else shutil.disk_usage(nearest).free
        try:
            store = Store.find(self.path)
            info = store.find_sequence(sequence) if store else None
        except (SinkError, Unreachable) as error:
            return DestinationStatus(exists=None, problem=str(error), free_bytes=free_bytes)
        return DestinationStatus(
            exists=store is not None,
            sequence=_existing(info) if info else None,
            problem=None if nearest is None else _folder_problem(nearest),
            free_bytes=free_bytes,
        )

    def find(self, sequence: str) -> ExistingSequence | None:
        """Return the stored sequence of this name, or None."""
        store = Store.find(self.path)
        info = store.find_sequence(sequence) if store else None
        return _existing(info) if info else None

    def find_all(self, sequences: Collection[str]) -> dict[str, ExistingSequence]:
        """Return the stored sequences with these names, without their topics."""
        store = Store.find(self.path)
        return {
            info.name: ExistingSequence(
                name=info.name,
                complete=info.incomplete is None,
                sessions=tuple(ExistingSession(session.id, session.metadata) for session in info.sessions),
            )
            for info in (store.catalog.headers(sequences) if store else ())
        }

    def open_sink(self, *, buffer_bytes: int) -> Sink:
        """Return a sink whose sessions wait for `commit`, after creating the store if necessary."""
        return StoreSink(Store.open(self.path), buffer_bytes, self.compression, deferred=True)

    def commit(self, sessions: Sequence[Session]) -> list[Exception | None]:
        """Commit closed sessions in one transaction; see `commit_sessions`."""
        return commit_sessions(cast("Sequence[StoreSession]", sessions))

    def discard(self, sessions: Sequence[Session]) -> None:
        """Discard closed sessions that are not committed."""
        for session in cast("Sequence[StoreSession]", sessions):
            session.discard()

    def family_topics(self, family: str | None, names: Collection[str]) -> tuple[FamilyTopic, ...]:
        """Return the topics with these names that sessions of the family created, oldest session first."""
        store = Store.find(self.path)
        return store.catalog.family_topics(family, names) if store else ()

    def delete_sessions(self, sequence: str, sessions: Collection[str]) -> bool:
        """Delete sessions of a sequence."""
        store = Store.open(self.path, create=False)
        for session in sessions:
            store.delete_session(sequence, session)
        return True

    @property
    def local_folder(self) -> Path | None:
        """The folder, or None for a URL."""
        return self.path if isinstance(self.path, Path) else None

    def keep_open(self) -> AbstractContextManager[object] | None:
        """Return a context that keeps the catalog open, or None if the store does not exist yet."""
        store = None if self.local_folder is None else Store.find(self.local_folder)
        return closing(store.catalog.keep_open()) if store else None


def _existing(info: SequenceInfo) -> ExistingSequence:
    return ExistingSequence(
        name=info.name,
        complete=info.incomplete is None,
        sessions=tuple(ExistingSession(session.id, session.metadata) for session in info.sessions),
        topics={
            topic.name: ExistingTopic(topic.session, topic.ontology, topic.metadata) for topic in info.topics
        },
    )


def _nearest_existing(folder: Path) -> Path:
    """Return the folder or its closest ancestor that exists."""
    return next(path for path in (folder, *folder.absolute().parents) if path.exists())


def _folder_problem(folder: Path) -> str | None:
    if not folder.is_dir():
        return f"{folder} is not a folder"
    return None if os.access(folder, os.W_OK | os.X_OK) else f"{folder} cannot be written"
