"""The SQLite catalog of a store: tables, queries, sessions and removal.

Every call has a connection for itself, so threads and forked processes share none. A catalog that was deleted is
detected instead of written to.
"""

from __future__ import annotations

import json
import os
import secrets
import sqlite3
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa

from mosaico_ingest.destinations import FamilyTopic, check_same_type, sequence_exists
from mosaico_ingest.destinations.store import sqlite
from mosaico_ingest.destinations.store.files import NotInStore, sequence_changed, translate_errors
from mosaico_ingest.destinations.store.model import (
    Claim,
    Listing,
    MergedSegment,
    NewNote,
    NewSession,
    NewTopic,
    Note,
    Replacement,
    SegmentInfo,
    SequenceFilter,
    SequenceInfo,
    SessionInfo,
    TopicInfo,
    attachments_of,
    check_not_merged,
)
from mosaico_ingest.destinations.store.segment import Segment
from mosaico_ingest.destinations.store.sqlite import (
    BUSY_S,
    Handle,
    connect,
    connection,
    family_topics,
    find_open,
    keep_open,
    listing,
)
from mosaico_ingest.errors import SequenceExists, SinkError
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.ontology.registry import OntologyType, SerializationFormat
from mosaico_ingest.remote import AnyPath

FORMAT = 2
"""The version of the tables; it increases if earlier releases cannot read them."""

_APPLICATION = 0x6D6F7361  # "mosa", which `file catalog.sqlite` shows

_LATER_COLUMNS = ("checksum", "merged")
"""Columns of segments that the first catalogs do not have."""

_STAMPS = ("user_version", "application_id")

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
    schema_digest TEXT NOT NULL REFERENCES schemas,
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
    checksum TEXT,
    merged TEXT
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
    """The catalog in the SQLite file at `path`, which `create` creates if necessary; see `StoreCatalog`."""

    def __init__(self, path: Path, *, create: bool) -> None:
        self.path = path
        self.root = path.parent
        with translate_errors(path):
            if create:
                path.parent.mkdir(parents=True, exist_ok=True)
            elif not path.is_file():
                raise SinkError("there is no store here", where=str(path.parent), hint="check the path")
            self._prepare(create=create)

    @contextmanager
    def read(self) -> Generator[sqlite3.Connection, None, None]:
        """Yield a connection that reads one consistent state of the catalog."""
        with self._task("BEGIN", mode="ro") as db:
            yield db

    @contextmanager
    def write(self, *, lasting: bool = True) -> Generator[sqlite3.Connection, None, None]:
        """Yield a connection inside a transaction; a power cut may undo a transaction that is not `lasting`."""
        with self._task("BEGIN IMMEDIATE", mode="rw", lasting=lasting) as db:
            yield db

    def keep_open(self) -> Handle:
        """See `StoreCatalog.keep_open`; calls reuse the connections of an open catalog."""
        with translate_errors(self.path):
            return keep_open(self.path)

    def claim(
        self, session: str, sequence: str, if_exists: IfExists, *, is_live: Callable[[str], bool]
    ) -> Claim:
        """See `StoreCatalog.claim`; a claim need not survive a power cut, which ends its writer too."""
        with self.write(lasting=False) as db:
            return _claim(db, session, sequence, if_exists, is_live=is_live)

    def commit(self, sessions: Sequence[tuple[Claim, NewSession]]) -> list[str]:
        """See `StoreCatalog.commit`."""
        with self.write() as db:
            return [path for claimed, new in sessions for path in _commit(db, claimed, new)]

    def replace_segments(self, change: Replacement) -> bool:
        """See `StoreCatalog.replace_segments`; a catalog of an earlier format is converted."""
        with translate_errors(self.path):
            self._prepare(create=True)
        with self.write() as db:
            return _replace_segments(db, change)

    def release(self, session: str, sequence: str) -> None:  # noqa: ARG002 - the session identifies the reservation
        """See `StoreCatalog.release`."""
        with self.write(lasting=False) as db:
            _release(db, session)

    def create(self, sequence: str, metadata: str) -> None:
        """See `StoreCatalog.create`."""
        with self.write() as db:
            _create(db, sequence, metadata)

    def note(self, sequence: str, new: NewNote) -> None:
        """See `StoreCatalog.note`."""
        with self.write() as db:
            _note(db, sequence, new)

    def names(self) -> list[str]:
        """See `StoreCatalog.names`."""
        with self.read() as db:
            return _names(db)

    def sequence(self, name: str) -> SequenceInfo | None:
        """See `StoreCatalog.sequence`."""
        with self.read() as db:
            return _find_sequence(db, name, self.root)

    def headers(self, names: Collection[str]) -> tuple[SequenceInfo, ...]:
        """See `StoreCatalog.headers`."""
        with self.read() as db:
            return _headers(db, names)

    def sequences(self) -> tuple[SequenceInfo, ...]:
        """See `StoreCatalog.sequences`."""
        with self.read() as db:
            infos = (_find_sequence(db, name, self.root) for name in _names(db))
            return tuple(info for info in infos if info is not None)

    def listing(self, selection: SequenceFilter, *, after: str | None, limit: int | None) -> Listing:
        """See `StoreCatalog.listing`."""
        with self.read() as db:
            return listing(db, selection, after=after, limit=limit)

    def family_topics(self, family: str | None, names: Collection[str]) -> tuple[FamilyTopic, ...]:
        """See `StoreCatalog.family_topics`."""
        with self.read() as db:
            return family_topics(db, family, names)

    def bounds(self, topic: TopicInfo, columns: Collection[str]) -> dict[AnyPath, dict[str, tuple[Any, Any]]]:
        """See `StoreCatalog.bounds`."""
        with self.read() as db:
            return _bounds(db, topic, columns, self.root)

    def delete_sequence(self, sequence: str) -> list[str]:
        """See `StoreCatalog.delete_sequence`."""
        with self.write() as db:
            return _delete_sequence(db, sequence)

    def delete_topic(self, sequence: str, topic: str) -> list[str]:
        """See `StoreCatalog.delete_topic`."""
        with self.write() as db:
            return _delete_topic(db, sequence, topic)

    def delete_session(self, sequence: str, session: str) -> list[str]:
        """See `StoreCatalog.delete_session`."""
        with self.write() as db:
            return _delete_session(db, sequence, session)

    def delete_notes(self, sequence: str, topic: str | None) -> None:
        """See `StoreCatalog.delete_notes`."""
        with self.write() as db:
            _delete_notes(db, sequence, topic)

    def forget(self, live: Collection[str]) -> set[str]:
        """See `StoreCatalog.forget`."""
        with self.write() as db:
            return _forget(db, live)

    @contextmanager
    def _task(
        self, begin: str, *, mode: str, lasting: bool = True
    ) -> Generator[sqlite3.Connection, None, None]:
        with translate_errors(self.path), connection(self.path, partial(self._connect, mode)) as db:
            # Without FULL, the WAL stays consistent, but its last transactions may be missing after a power cut.
            db.execute(f"PRAGMA synchronous = {'FULL' if lasting else 'NORMAL'}")
            db.execute(begin)
            try:
                yield db
            except BaseException:
                db.rollback()
                raise
            db.commit()

    def _connect(self, mode: str) -> sqlite3.Connection:
        try:
            return connect(self.path, f"mode={mode}")
        except sqlite3.OperationalError:
            if mode != "ro" or not self.path.is_file() or os.access(self.path.parent, os.W_OK):
                raise
            return connect(self.path, "immutable=1")  # a read-only medium cannot hold the files of the WAL

    def _prepare(self, *, create: bool) -> None:
        if create and not self.path.exists():
            self._create_atomically()
        catalog = find_open(self.path)
        if catalog is not None and (catalog.is_current or not create):
            return
        with closing(self._connect("rw" if create else "ro")) as db:
            if create:
                _initialize(db, self.path)
                _use_wal(db)
            version = _format(db, self.path)
            if create and version <= FORMAT:  # a catalog of a newer format must not be changed
                version = _convert(db)
        if version > FORMAT:
            raise SinkError(
                f"the store has format {version}, this version supports up to {FORMAT}",
                where=str(self.path.parent),
                hint="upgrade mosaico-ingest",
            )
        if version == 0:
            raise SinkError("there is no store here", where=str(self.path.parent), hint="check the path")
        if catalog is not None:
            catalog.is_current = create

    def _create_atomically(self) -> None:
        """Create the catalog under its name only when it is initialized, so that no process sees an incomplete catalog."""
        draft = self.path.with_name(f".{self.path.name}-{secrets.token_hex(8)}")
        try:
            with closing(connect(draft, "mode=rwc")) as db:
                _initialize(db, draft)
                # On a full disk, an earlier log would keep the tables, and the log is not linked.
                _use_wal(db)
            try:
                os.link(draft, self.path)
            except FileExistsError:
                pass  # another process created it
            except OSError:  # the file system has no hard links
                if not self.path.exists():
                    draft.replace(self.path)
        finally:
            for file in self.path.parent.glob(f"{draft.name}*"):
                file.unlink(missing_ok=True)


def _format(db: sqlite3.Connection, path: Path) -> int:
    """Return the format of a catalog, 0 for an empty file.

    Raises:
        SinkError: The file is another database.
    """
    version, application = (db.execute(f"PRAGMA {name}").fetchone()[0] for name in _STAMPS)
    tables = db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
    if application != _APPLICATION and (application or version or tables):
        raise SinkError("the file is not the catalog of a store", where=str(path), hint="check the path")
    return int(version)


def _initialize(db: sqlite3.Connection, path: Path) -> None:
    """Create the tables if the file is empty."""
    if _format(db, path) != 0:
        return
    db.execute("BEGIN IMMEDIATE")
    if _format(db, path) == 0:  # another process may have been faster
        for statement in (_TABLES + sqlite.TABLE).split(";"):
            db.execute(statement)
        db.execute(f"PRAGMA application_id = {_APPLICATION}")
        db.execute(f"PRAGMA user_version = {FORMAT}")
    db.execute("COMMIT")


def _use_wal(db: sqlite3.Connection) -> None:
    deadline = time.monotonic() + BUSY_S
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


def _convert(db: sqlite3.Connection) -> int:
    """Convert a catalog of an earlier format or version, and return its format."""
    if _version(db) == FORMAT:
        return FORMAT
    db.execute("BEGIN IMMEDIATE")
    if _version(db) == 1:  # another process may have been faster
        for column in _missing_columns(db):
            db.execute(f"ALTER TABLE segments ADD COLUMN {column} TEXT")
        sqlite.convert(db)
        db.execute(f"PRAGMA user_version = {FORMAT}")
    db.execute("COMMIT")
    return _version(db)


def _version(db: sqlite3.Connection) -> int:
    return int(db.execute("PRAGMA user_version").fetchone()[0])


def _missing_columns(db: sqlite3.Connection) -> list[str]:
    rows = db.execute("SELECT name FROM pragma_table_info('segments')").fetchall()
    columns = {row["name"] for row in rows}
    return [name for name in _LATER_COLUMNS if columns and name not in columns]


def _names(db: sqlite3.Connection) -> list[str]:
    """Return the sorted names of all sequences."""
    return [row["name"] for row in db.execute("SELECT name FROM sequences ORDER BY name")]


def _find_sequence(db: sqlite3.Connection, name: str, root: Path) -> SequenceInfo | None:
    """Return a sequence, or None."""
    row = db.execute("SELECT * FROM sequences WHERE name = ?", (name,)).fetchone()
    if row is None:
        return None
    sessions = _session_infos(db, row["id"])
    return SequenceInfo(
        name=name,
        metadata=json.loads(row["metadata"]),
        created_ns=row["created_ns"],
        sessions=sessions,
        attachments=attachments_of(sessions, root),
        topics=_topics(db, row["id"], name, root),
        notes=_notes(db, row["id"]),
    )


def _headers(db: sqlite3.Connection, names: Collection[str]) -> tuple[SequenceInfo, ...]:
    """Return the sequences with these names, without their topics."""
    # One parameter with all names: SQLite limits the number of parameters.
    among = "IN (SELECT value FROM json_each(?))"
    rows = db.execute(f"SELECT * FROM sequences WHERE name {among}", (json.dumps(list(names)),)).fetchall()  # noqa: S608 - `among` is a constant
    ids = json.dumps([row["id"] for row in rows])
    sessions: dict[int, list[SessionInfo]] = defaultdict(list)
    for row in db.execute(f"SELECT * FROM sessions WHERE sequence_id {among} ORDER BY id", (ids,)):  # noqa: S608 - `among` is a constant
        sessions[row["sequence_id"]].append(_session_info(row))
    notes: dict[int, list[Note]] = defaultdict(list)
    for row in db.execute(f"SELECT * FROM notes WHERE sequence_id {among} ORDER BY id", (ids,)):  # noqa: S608 - `among` is a constant
        notes[row["sequence_id"]].append(_note_of(row))
    return tuple(
        SequenceInfo(
            name=row["name"],
            metadata=json.loads(row["metadata"]),
            created_ns=row["created_ns"],
            sessions=tuple(sessions[row["id"]]),
            topics=(),
            notes=tuple(notes[row["id"]]),
        )
        for row in rows
    )


def _bounds(
    db: sqlite3.Connection, topic: TopicInfo, columns: Collection[str], root: Path
) -> dict[AnyPath, dict[str, tuple[Any, Any]]]:
    """Return the bounds of the requested columns by segment path."""
    result: dict[AnyPath, dict[str, tuple[Any, Any]]] = defaultdict(dict)
    rows = db.execute(
        "SELECT path, column_path, low, high FROM bounds JOIN segments ON segments.id = segment_id"
        " JOIN topics ON topics.id = topic_id JOIN sequences ON sequences.id = sequence_id"
        " WHERE sequences.name = ? AND topics.name = ?",
        (topic.sequence, topic.name),
    )
    for row in rows:
        if row["column_path"] in columns:
            result[root / row["path"]][row["column_path"]] = (row["low"], row["high"])
    return result


def _session_infos(db: sqlite3.Connection, sequence_id: int) -> tuple[SessionInfo, ...]:
    rows = db.execute("SELECT * FROM sessions WHERE sequence_id = ? ORDER BY id", (sequence_id,))
    return tuple(map(_session_info, rows))


def _session_info(row: sqlite3.Row) -> SessionInfo:
    return SessionInfo(row["id"], json.loads(row["metadata"]), row["created_ns"], row["completed_ns"])


def _topics(db: sqlite3.Connection, sequence_id: int, name: str, root: Path) -> tuple[TopicInfo, ...]:
    segments = _segments(db, sequence_id, root)
    rows = db.execute("SELECT * FROM topics WHERE sequence_id = ? ORDER BY name", (sequence_id,))
    return tuple(
        TopicInfo(
            sequence=name,
            name=row["name"],
            session=row["session_id"],
            ontology=_ontology_of(db, row),
            schema=sqlite.schema_of(db, row),
            metadata=json.loads(row["metadata"]),
            created_ns=row["created_ns"],
            segments=tuple(segments[row["id"]]),
        )
        for row in rows
    )


def _segments(db: sqlite3.Connection, sequence_id: int, root: Path) -> dict[int, list[SegmentInfo]]:
    segments: dict[int, list[SegmentInfo]] = defaultdict(list)
    rows = db.execute(
        "SELECT segments.* FROM segments JOIN topics ON topics.id = topic_id WHERE sequence_id = ?"
        " ORDER BY start_ns, segments.session_id, path",
        (sequence_id,),
    )
    for row in rows:
        segments[row["topic_id"]].append(
            SegmentInfo(
                path=root / row["path"],
                session=row["session_id"],
                rows=row["rows"],
                stored_bytes=row["bytes"],
                start_ns=row["start_ns"],
                end_ns=row["end_ns"],
                checksum=_later(row, "checksum"),
                merged=_merged(row),
            )
        )
    return segments


def _later(row: sqlite3.Row, column: str) -> str | None:
    """Return the value of a column that early catalogs do not have."""
    return row[column] if column in row.keys() else None  # noqa: SIM118 - `in` searches the values of a row


def _merged(row: sqlite3.Row) -> tuple[MergedSegment, ...]:
    text = _later(row, "merged")
    return tuple(MergedSegment(session, checksum) for session, checksum in json.loads(text)) if text else ()


def _notes(db: sqlite3.Connection, sequence_id: int) -> tuple[Note, ...]:
    rows = db.execute("SELECT * FROM notes WHERE sequence_id = ? ORDER BY id", (sequence_id,))
    return tuple(map(_note_of, rows))


def _note_of(row: sqlite3.Row) -> Note:
    return Note(row["topic"], row["message"], row["created_ns"])


def _claim(
    db: sqlite3.Connection,
    session: str,
    sequence: str,
    if_exists: IfExists,
    *,
    is_live: Callable[[str], bool],
) -> Claim:
    """Reserve a sequence for a session that creates or replaces it; see `StoreCatalog.claim`."""
    row = db.execute("SELECT id FROM sequences WHERE name = ?", (sequence,)).fetchone()
    if row is not None and if_exists in {IfExists.FAIL, IfExists.SKIP}:
        raise sequence_exists(sequence)
    if if_exists is not IfExists.APPEND:
        _reserve(db, session, sequence, is_live)
    if row is None:
        return Claim(sequence, if_exists, None, (), {})
    types = _types(db, row["id"]) if if_exists is IfExists.APPEND else {}
    return Claim(sequence, if_exists, row["id"], _session_ids(db, row["id"]), types)


def _reserve(db: sqlite3.Connection, session: str, sequence: str, is_live: Callable[[str], bool]) -> None:
    for other in db.execute("SELECT session_id FROM reservations WHERE sequence = ?", (sequence,)).fetchall():
        if is_live(other["session_id"]):
            raise SequenceExists("another run is writing this sequence", where=sequence, hint="wait for it")
        _release(db, other["session_id"])
    db.execute("INSERT INTO reservations VALUES (?, ?)", (session, sequence))


def _release(db: sqlite3.Connection, session: str) -> None:
    """Delete the reservation of a session."""
    db.execute("DELETE FROM reservations WHERE session_id = ?", (session,))


def _create(db: sqlite3.Connection, sequence: str, metadata: str) -> None:
    """Insert a sequence without a session."""
    if db.execute("SELECT 1 FROM sequences WHERE name = ?", (sequence,)).fetchone() is not None:
        raise sequence_exists(sequence)
    db.execute(
        "INSERT INTO sequences (name, metadata, created_ns) VALUES (?, ?, ?)",
        (sequence, metadata, time.time_ns()),
    )


def _note(db: sqlite3.Connection, sequence: str, new: NewNote) -> None:
    """Attach a note to an existing sequence."""
    entered = db.execute(
        "INSERT INTO notes (sequence_id, topic, message, created_ns)"
        " SELECT id, ?, ?, ? FROM sequences WHERE name = ?",
        (new.topic, new.message, new.created_ns, sequence),
    )
    if not entered.rowcount:
        raise NotInStore(f"there is no sequence {sequence!r}")


def _commit(db: sqlite3.Connection, claimed: Claim, new: NewSession) -> list[str]:
    """Insert a session and return the paths of the segments it replaces."""
    replaced = _check_unchanged(db, claimed)
    sequence_id = _sequence(db, claimed, new)
    db.execute(
        "INSERT INTO sessions VALUES (?, ?, ?, ?, ?)",
        (new.id, sequence_id, new.metadata, new.created_ns, time.time_ns()),
    )
    existing = _types(db, sequence_id)
    for topic in new.topics:
        if topic.name in existing:
            check_same_type(existing[topic.name], topic.ontology, where=topic.name)
        _enter_segments(db, _topic(db, sequence_id, new.id, topic), new.id, topic.segments)
    db.executemany(
        "INSERT INTO notes (sequence_id, topic, message, created_ns) VALUES (?, ?, ?, ?)",
        [(sequence_id, note.topic, note.message, note.created_ns) for note in new.notes],
    )
    _release(db, new.id)
    return replaced


def _check_unchanged(db: sqlite3.Connection, claimed: Claim) -> list[str]:
    """Return the segments to replace, or raise if another session changed the sequence since the claim."""
    row = db.execute("SELECT id FROM sequences WHERE name = ?", (claimed.sequence,)).fetchone()
    now = None if row is None else row["id"]
    replaces = claimed.if_exists is IfExists.REPLACE
    if now is not None and claimed.if_exists in {IfExists.FAIL, IfExists.SKIP}:
        raise sequence_exists(claimed.sequence)
    if claimed.sequence_id is not None and now != claimed.sequence_id:
        raise sequence_changed(claimed.sequence)
    if replaces and now is not None and _session_ids(db, now) != claimed.sessions:
        raise sequence_changed(claimed.sequence)
    if not replaces or now is None:
        return []
    paths = db.execute(
        "SELECT path FROM segments JOIN topics ON topics.id = topic_id WHERE sequence_id = ?", (now,)
    ).fetchall()
    db.execute("DELETE FROM sequences WHERE id = ?", (now,))
    return [path["path"] for path in paths]


def _sequence(db: sqlite3.Connection, claimed: Claim, new: NewSession) -> int:
    db.execute(
        "INSERT INTO sequences (name, metadata, created_ns) VALUES (?, ?, ?) ON CONFLICT (name) DO NOTHING",
        (claimed.sequence, new.metadata, new.created_ns),
    )
    row = db.execute("SELECT id FROM sequences WHERE name = ?", (claimed.sequence,)).fetchone()
    return int(row["id"])


def _topic(db: sqlite3.Connection, sequence_id: int, session: str, topic: NewTopic) -> int:
    db.execute(
        "INSERT INTO topics (sequence_id, session_id, name, ontology_tag, serialization_format, fingerprint,"
        " schema_digest, metadata, created_ns) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)"
        " ON CONFLICT (sequence_id, name) DO NOTHING",
        (
            sequence_id,
            session,
            topic.name,
            topic.ontology.tag,
            topic.ontology.serialization_format.value,
            topic.ontology.fingerprint,
            sqlite.store_schema(db, topic.schema),
            topic.metadata,
            topic.created_ns,
        ),
    )
    row = db.execute("SELECT id FROM topics WHERE sequence_id = ? AND name = ?", (sequence_id, topic.name))
    return int(row.fetchone()["id"])


def _enter_segments(
    db: sqlite3.Connection, topic_id: int, session: str, segments: Mapping[str, Segment]
) -> None:
    for path, segment in segments.items():
        cursor = db.execute(
            "INSERT INTO segments (topic_id, session_id, path, rows, bytes, start_ns, end_ns, checksum)"
            " VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
            (
                topic_id,
                session,
                path,
                segment.rows,
                segment.stored_bytes,
                segment.start_ns,
                segment.end_ns,
                segment.checksum,
            ),
        )
        db.executemany(
            "INSERT INTO bounds VALUES (?, ?, ?, ?)",
            [(cursor.lastrowid, *bounds) for bounds in segment.bounds],
        )


def _replace_segments(db: sqlite3.Connection, change: Replacement) -> bool:
    """Enter a merged segment in place of others, if the catalog still contains all of them."""
    row = db.execute(
        "SELECT topics.id FROM topics JOIN sequences ON sequences.id = sequence_id"
        " WHERE sequences.name = ? AND topics.name = ?",
        (change.sequence, change.topic),
    ).fetchone()
    topic = None if row is None else int(row["id"])
    paths = set(_paths(db, "topic_id = ?", topic)) if topic is not None else set[str]()
    if topic is None or not paths.issuperset(change.replaced):
        return False
    db.executemany("DELETE FROM segments WHERE path = ?", [(path,) for path in change.replaced])
    _enter_segments(db, topic, change.session, {change.path: change.segment})
    merged = json.dumps([(part.session, part.checksum) for part in change.merged])
    db.execute("UPDATE segments SET merged = ? WHERE path = ?", (merged, change.path))
    return True


def _session_ids(db: sqlite3.Connection, sequence_id: int) -> tuple[str, ...]:
    rows = db.execute("SELECT id FROM sessions WHERE sequence_id = ? ORDER BY id", (sequence_id,))
    return tuple(row["id"] for row in rows)


def _types(db: sqlite3.Connection, sequence_id: int) -> dict[str, OntologyType]:
    rows = db.execute("SELECT * FROM topics WHERE sequence_id = ?", (sequence_id,))
    return {row["name"]: _ontology_of(db, row) for row in rows}


def _ontology_of(db: sqlite3.Connection, row: sqlite3.Row) -> OntologyType:
    """Return the ontology type of a row of `topics`."""
    columns = list(sqlite.schema_of(db, row))[1:]
    return OntologyType(
        row["ontology_tag"], pa.struct(columns), SerializationFormat(row["serialization_format"])
    )


def _delete_sequence(db: sqlite3.Connection, name: str) -> list[str]:
    """Remove a sequence and return the paths of its segments."""
    owner = _sequence_id(db, name)
    paths = _paths(db, "topic_id IN (SELECT id FROM topics WHERE sequence_id = ?)", owner)
    db.execute("DELETE FROM sequences WHERE id = ?", (owner,))
    return paths


def _delete_topic(db: sqlite3.Connection, sequence_name: str, name: str) -> list[str]:
    """Remove a topic and return the paths of its segments."""
    owner = _sequence_id(db, sequence_name)
    row = db.execute("SELECT id FROM topics WHERE sequence_id = ? AND name = ?", (owner, name)).fetchone()
    if row is None:
        raise NotInStore(f"there is no topic {name!r}", where=sequence_name)
    paths = _paths(db, "topic_id = ?", row["id"])
    db.execute("DELETE FROM topics WHERE id = ?", (row["id"],))
    db.execute("DELETE FROM notes WHERE sequence_id = ? AND topic = ?", (owner, name))
    return paths


def _delete_session(db: sqlite3.Connection, sequence_name: str, session_id: str) -> list[str]:
    """Remove a session, with the topics only it wrote to, and return the paths of its segments."""
    owner = _sequence_id(db, sequence_name)
    rows = db.execute(
        "SELECT segments.* FROM segments JOIN topics ON topics.id = topic_id WHERE sequence_id = ?", (owner,)
    )
    check_not_merged(session_id, sequence_name, map(_merged, rows))
    paths = _paths(db, "session_id = ?", session_id)
    if not db.execute("DELETE FROM sessions WHERE id = ? AND sequence_id = ?", (session_id, owner)).rowcount:
        raise NotInStore(f"there is no session {session_id!r}", where=sequence_name)
    db.execute(
        "DELETE FROM topics WHERE session_id = ? AND id NOT IN (SELECT topic_id FROM segments)", (session_id,)
    )
    return paths


def _delete_notes(db: sqlite3.Connection, sequence_name: str, topic_name: str | None) -> None:
    """Remove the notes of a sequence, or those of one of its topics."""
    owner = _sequence_id(db, sequence_name)
    db.execute("DELETE FROM notes WHERE sequence_id = ? AND topic IS ?", (owner, topic_name))


def _forget(db: sqlite3.Connection, live: Collection[str]) -> set[str]:
    """Remove the reservations of sessions that are not live and return the paths of all segments."""
    for row in db.execute("SELECT session_id FROM reservations").fetchall():
        if row["session_id"] not in live:
            db.execute("DELETE FROM reservations WHERE session_id = ?", (row["session_id"],))
    sqlite.remove_unused(db)
    return set(_paths(db, "?", 1))


def _sequence_id(db: sqlite3.Connection, name: str) -> int:
    row = db.execute("SELECT id FROM sequences WHERE name = ?", (name,)).fetchone()
    if row is None:
        raise NotInStore(f"there is no sequence {name!r}")
    return int(row["id"])


def _paths(db: sqlite3.Connection, condition: str, value: int | str) -> list[str]:
    rows = db.execute(f"SELECT path FROM segments WHERE {condition}", (value,))  # noqa: S608 - the conditions are constants of this module
    return [row["path"] for row in rows]
