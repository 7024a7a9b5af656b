"""This file is the catalog's format and how to reach it: one SQLite file, a connection for each task.

A connection lives only for one task, so threads and forked processes share nothing, and a catalog that
was deleted is noticed instead of being written to after its end.
"""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Callable, Collection, Generator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from mosaico_ingest.errors import SinkError
from mosaico_ingest.policies import IfExists
from mosaico_ingest.remote.path import AnyPath
from mosaico_ingest.store import entries, queries, removal
from mosaico_ingest.store.faults import explained
from mosaico_ingest.store.model import SequenceInfo, TopicInfo

__all__ = ["FORMAT", "Catalog"]

FORMAT = 1
"""Counts up when a catalog can no longer be read by what was released before."""

_APPLICATION = 0x6D6F7361  # "mosa", which `file catalog.sqlite` shows
_BUSY_S = 30.0

_TABLES = """
CREATE TABLE sequences (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    name TEXT NOT NULL UNIQUE,
    metadata TEXT NOT NULL,
    created_ns INTEGER NOT NULL
);
CREATE TABLE sessions (
    id TEXT PRIMARY KEY,
    sequence_id INTEGER NOT NULL REFERENCES sequences ON DELETE CASCADE,
    metadata TEXT NOT NULL,
    created_ns INTEGER NOT NULL,
    completed_ns INTEGER NOT NULL
);
CREATE INDEX sessions_of_sequence ON sessions (sequence_id);
CREATE TABLE topics (
    id INTEGER PRIMARY KEY,
    sequence_id INTEGER NOT NULL REFERENCES sequences ON DELETE CASCADE,
    session_id TEXT NOT NULL,
    name TEXT NOT NULL,
    ontology_tag TEXT NOT NULL,
    serialization_format TEXT NOT NULL,
    fingerprint TEXT NOT NULL,
    arrow_schema BLOB NOT NULL,
    metadata TEXT NOT NULL,
    created_ns INTEGER NOT NULL,
    UNIQUE (sequence_id, name)
);
CREATE TABLE segments (
    id INTEGER PRIMARY KEY,
    topic_id INTEGER NOT NULL REFERENCES topics ON DELETE CASCADE,
    session_id TEXT NOT NULL REFERENCES sessions ON DELETE CASCADE,
    path TEXT NOT NULL UNIQUE,
    rows INTEGER NOT NULL,
    bytes INTEGER NOT NULL,
    start_ns INTEGER NOT NULL,
    end_ns INTEGER NOT NULL,
    checksum TEXT
);
CREATE INDEX segments_of_topic ON segments (topic_id, start_ns);
CREATE INDEX segments_of_session ON segments (session_id);
CREATE TABLE bounds (
    segment_id INTEGER NOT NULL REFERENCES segments ON DELETE CASCADE,
    column_path TEXT NOT NULL,
    low,
    high,
    PRIMARY KEY (segment_id, column_path)
) WITHOUT ROWID;
CREATE TABLE notes (
    id INTEGER PRIMARY KEY,
    sequence_id INTEGER NOT NULL REFERENCES sequences ON DELETE CASCADE,
    topic TEXT,
    message TEXT NOT NULL,
    created_ns INTEGER NOT NULL
);
CREATE INDEX notes_of_sequence ON notes (sequence_id);
CREATE TABLE reservations (
    session_id TEXT PRIMARY KEY,
    sequence TEXT NOT NULL
);
"""


class Catalog:
    """The `Records` in the SQLite file at `path`; `create` makes it where it is not there."""

    def __init__(self, path: Path, *, create: bool) -> None:
        self.path = path
        self.root = path.parent
        with explained(path):
            if create:
                path.parent.mkdir(parents=True, exist_ok=True)
            elif not path.is_file():
                raise SinkError("there is no store here", where=str(path.parent), hint="check the path")
            self._prepare(create=create)

    @contextmanager
    def read(self) -> Generator[sqlite3.Connection, None, None]:
        """Give a connection that sees one state of the catalog throughout."""
        with self._task("BEGIN", mode="ro") as db:
            yield db

    @contextmanager
    def write(self, *, lasting: bool = True) -> Generator[sqlite3.Connection, None, None]:
        """Give a connection inside a transaction: all of it happens, or nothing; a power cut may undo what need not last."""
        with self._task("BEGIN IMMEDIATE", mode="rw", lasting=lasting) as db:
            yield db

    def keep_open(self) -> sqlite3.Connection:
        """Give an idle connection: closing the last one costs a checkpoint, closing another while it is open does not."""
        with explained(self.path):
            return self._connect("rw")

    def claim(
        self, session: str, sequence: str, if_exists: IfExists, *, is_live: Callable[[str], bool]
    ) -> entries.Claim:
        """See `Records.claim`; a claim means nothing once its writer is dead, as it is after a power cut."""
        with self.write(lasting=False) as db:
            return entries.claim(db, session, sequence, if_exists, is_live=is_live)

    def commit(self, claimed: entries.Claim, new: entries.NewSession) -> list[str]:
        """See `Records.commit`."""
        with self.write() as db:
            return entries.commit(db, claimed, new)

    def release(self, session: str, sequence: str) -> None:  # noqa: ARG002 - the session says it all
        """See `Records.release`."""
        with self.write(lasting=False) as db:
            entries.release(db, session)

    def create(self, sequence: str, metadata: str) -> None:
        """See `Records.create`."""
        with self.write() as db:
            entries.create(db, sequence, metadata)

    def note(self, sequence: str, new: entries.NewNote) -> None:
        """See `Records.note`."""
        with self.write() as db:
            entries.note(db, sequence, new)

    def names(self) -> list[str]:
        """See `Records.names`."""
        with self.read() as db:
            return queries.names(db)

    def sequence(self, name: str) -> SequenceInfo | None:
        """See `Records.sequence`."""
        with self.read() as db:
            return queries.sequence(db, name, self.root)

    def sequences(self) -> tuple[SequenceInfo, ...]:
        """See `Records.sequences`."""
        with self.read() as db:
            found = (queries.sequence(db, name, self.root) for name in queries.names(db))
            return tuple(info for info in found if info is not None)

    def bounds(self, topic: TopicInfo, columns: Collection[str]) -> dict[AnyPath, dict[str, tuple[Any, Any]]]:
        """See `Records.bounds`."""
        with self.read() as db:
            return queries.bounds(db, topic, columns, self.root)

    def delete_sequence(self, sequence: str) -> list[str]:
        """See `Records.delete_sequence`."""
        with self.write() as db:
            return removal.sequence(db, sequence)

    def delete_topic(self, sequence: str, topic: str) -> list[str]:
        """See `Records.delete_topic`."""
        with self.write() as db:
            return removal.topic(db, sequence, topic)

    def delete_session(self, sequence: str, session: str) -> list[str]:
        """See `Records.delete_session`."""
        with self.write() as db:
            return removal.session(db, sequence, session)

    def delete_notes(self, sequence: str, topic: str | None) -> None:
        """See `Records.delete_notes`."""
        with self.write() as db:
            removal.notes(db, sequence, topic)

    def forget(self, live: Collection[str]) -> set[str]:
        """See `Records.forget`."""
        with self.write() as db:
            return removal.forget(db, live)

    @contextmanager
    def _task(
        self, begin: str, *, mode: str, lasting: bool = True
    ) -> Generator[sqlite3.Connection, None, None]:
        with explained(self.path), closing(self._connect(mode)) as db:
            if not lasting:
                # A WAL stays whole then, and its last transactions may be missing.
                db.execute("PRAGMA synchronous = NORMAL")
            db.execute(begin)
            try:
                yield db
            except BaseException:
                db.rollback()
                raise
            db.commit()

    def _connect(self, mode: str) -> sqlite3.Connection:
        try:
            return self._opened(f"mode={mode}")
        except sqlite3.OperationalError:
            if mode != "ro" or not self.path.is_file() or os.access(self.path.parent, os.W_OK):
                raise
            return self._opened("immutable=1")  # a read-only medium has no room for the files of the WAL

    def _opened(self, query: str) -> sqlite3.Connection:
        uri = f"{self.path.absolute().as_uri()}?{query}"
        db = sqlite3.connect(uri, uri=True, timeout=_BUSY_S, isolation_level=None, check_same_thread=False)
        try:
            db.row_factory = sqlite3.Row
            db.execute("PRAGMA foreign_keys = ON")
            db.execute("PRAGMA synchronous = FULL")
            db.execute("SELECT count(*) FROM sqlite_master")
        except sqlite3.Error:
            db.close()
            raise
        return db

    def _prepare(self, *, create: bool) -> None:
        with closing(self._connect("rwc" if create else "ro")) as db:
            if create and self._format(db) == 0:
                _use_wal(db)
                db.execute("BEGIN IMMEDIATE")
                if self._format(db) == 0:  # no other process was faster
                    for statement in _TABLES.split(";"):
                        db.execute(statement)
                    db.execute(f"PRAGMA application_id = {_APPLICATION}")
                    db.execute(f"PRAGMA user_version = {FORMAT}")
                db.execute("COMMIT")
            found = self._format(db)
            if create and found == FORMAT:  # a newer one is not ours to change
                _complete(db)
        if found > FORMAT:
            raise SinkError(
                f"the store has format {found}, this version knows up to {FORMAT}",
                where=str(self.path.parent),
                hint="upgrade mosaico-ingest",
            )
        if found == 0:
            raise SinkError("there is no store here", where=str(self.path.parent), hint="check the path")

    def _format(self, db: sqlite3.Connection) -> int:
        version, application = (db.execute(f"PRAGMA {name}").fetchone()[0] for name in _STAMPS)
        tables = db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        if application != _APPLICATION and (application or version or tables):
            raise SinkError("the file is no catalog of a store", where=str(self.path), hint="check the path")
        return int(version)


_STAMPS = ("user_version", "application_id")


def _complete(db: sqlite3.Connection) -> None:
    """Add what catalogs of the same format once did without."""
    if not _has_checksums(db):
        db.execute("BEGIN IMMEDIATE")
        if not _has_checksums(db):  # no other process was faster
            db.execute("ALTER TABLE segments ADD COLUMN checksum TEXT")
        db.execute("COMMIT")


def _has_checksums(db: sqlite3.Connection) -> bool:
    columns = db.execute("SELECT name FROM pragma_table_info('segments')").fetchall()
    return not columns or ("checksum",) in map(tuple, columns)


def _use_wal(db: sqlite3.Connection) -> None:
    deadline = time.monotonic() + _BUSY_S
    while not _switched_to_wal(db) and time.monotonic() < deadline:
        time.sleep(0.01)


def _switched_to_wal(db: sqlite3.Connection) -> bool:
    try:
        db.execute("PRAGMA journal_mode = WAL")
    except sqlite3.OperationalError as err:  # this pragma does not wait for others by itself
        if "locked" not in str(err):
            raise
        return False
    return True
