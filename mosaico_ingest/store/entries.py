"""This file writes sessions to the SQLite catalog: the claim on a name when one begins, all it wrote when it commits."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Mapping

import pyarrow as pa

from mosaico_ingest.errors import SequenceExists, SinkError
from mosaico_ingest.frozen import frozen
from mosaico_ingest.ontology.types import OntologyType, SerializationFormat
from mosaico_ingest.policies import IfExists
from mosaico_ingest.sink import check_same_type, sequence_exists
from mosaico_ingest.store.faults import NotInStore
from mosaico_ingest.store.segment import Segment

__all__ = [
    "Claim",
    "NewNote",
    "NewSession",
    "NewTopic",
    "changed",
    "claim",
    "commit",
    "create",
    "note",
    "ontology_of",
    "release",
]


@frozen
class Claim:
    """The sequence as it was when the session began; the commit insists on finding it so."""

    sequence: str
    if_exists: IfExists
    sequence_id: int | None
    sessions: tuple[str, ...]
    types: Mapping[str, OntologyType]
    """What its topics hold, for a session that appends to them."""


@frozen
class NewTopic:
    """A topic of the session, and its segments under the paths the catalog will know them by."""

    name: str
    ontology: OntologyType
    schema: pa.Schema
    metadata: str
    created_ns: int
    segments: Mapping[str, Segment]


@frozen
class NewNote:
    """An error to attach."""

    topic: str | None
    message: str
    created_ns: int


@frozen
class NewSession:
    """All a session wrote."""

    id: str
    metadata: str
    created_ns: int
    topics: tuple[NewTopic, ...]
    notes: tuple[NewNote, ...]


def claim(
    db: sqlite3.Connection,
    session: str,
    sequence: str,
    if_exists: IfExists,
    *,
    is_live: Callable[[str], bool],
) -> Claim:
    """Note that a session will create or replace a sequence, or refuse because it must not or another does."""
    row = db.execute("SELECT id FROM sequences WHERE name = ?", (sequence,)).fetchone()
    if row is not None and if_exists in {IfExists.FAIL, IfExists.SKIP}:
        raise sequence_exists(sequence)
    if if_exists is not IfExists.APPEND:
        _reserve(db, session, sequence, is_live)
    if row is None:
        return Claim(sequence, if_exists, None, (), {})
    types = _types(db, row["id"]) if if_exists is IfExists.APPEND else {}
    return Claim(sequence, if_exists, row["id"], _sessions(db, row["id"]), types)


def create(db: sqlite3.Connection, sequence: str, metadata: str) -> None:
    """Enter a sequence without a session."""
    if db.execute("SELECT 1 FROM sequences WHERE name = ?", (sequence,)).fetchone() is not None:
        raise sequence_exists(sequence)
    db.execute(
        "INSERT INTO sequences (name, metadata, created_ns) VALUES (?, ?, ?)",
        (sequence, metadata, time.time_ns()),
    )


def note(db: sqlite3.Connection, sequence: str, new: NewNote) -> None:
    """Attach a note to a sequence that is there."""
    entered = db.execute(
        "INSERT INTO notes (sequence_id, topic, message, created_ns)"
        " SELECT id, ?, ?, ? FROM sequences WHERE name = ?",
        (new.topic, new.message, new.created_ns, sequence),
    )
    if not entered.rowcount:
        raise NotInStore(f"there is no sequence {sequence!r}")


def release(db: sqlite3.Connection, session: str) -> None:
    """Give the name back."""
    db.execute("DELETE FROM reservations WHERE session_id = ?", (session,))


def commit(db: sqlite3.Connection, claimed: Claim, new: NewSession) -> list[str]:
    """Enter a session and return the paths of the segments it replaces."""
    replaced = _check_unchanged(db, claimed)
    sequence_id = _sequence(db, claimed, new)
    db.execute(
        "INSERT INTO sessions VALUES (?, ?, ?, ?, ?)",
        (new.id, sequence_id, new.metadata, new.created_ns, time.time_ns()),
    )
    held = _types(db, sequence_id)
    for topic in new.topics:
        if topic.name in held:
            check_same_type(held[topic.name], topic.ontology, where=topic.name)
        _enter_segments(db, _topic(db, sequence_id, new.id, topic), new.id, topic.segments)
    db.executemany(
        "INSERT INTO notes (sequence_id, topic, message, created_ns) VALUES (?, ?, ?, ?)",
        [(sequence_id, note.topic, note.message, note.created_ns) for note in new.notes],
    )
    release(db, new.id)
    return replaced


def _reserve(db: sqlite3.Connection, session: str, sequence: str, is_live: Callable[[str], bool]) -> None:
    for other in db.execute("SELECT session_id FROM reservations WHERE sequence = ?", (sequence,)).fetchall():
        if is_live(other["session_id"]):
            raise SequenceExists("another run is writing this sequence", where=sequence, hint="wait for it")
        release(db, other["session_id"])
    db.execute("INSERT INTO reservations VALUES (?, ?)", (session, sequence))


def _check_unchanged(db: sqlite3.Connection, claimed: Claim) -> list[str]:
    """Return the segments to be replaced, or refuse because somebody else changed the sequence meanwhile."""
    row = db.execute("SELECT id FROM sequences WHERE name = ?", (claimed.sequence,)).fetchone()
    now = None if row is None else row["id"]
    replaces = claimed.if_exists is IfExists.REPLACE
    if now is not None and claimed.if_exists in {IfExists.FAIL, IfExists.SKIP}:
        raise sequence_exists(claimed.sequence)
    if claimed.sequence_id is not None and now != claimed.sequence_id:
        raise changed(claimed.sequence)
    if replaces and now is not None and _sessions(db, now) != claimed.sessions:
        raise changed(claimed.sequence)
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
        " arrow_schema, metadata, created_ns) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)"
        " ON CONFLICT (sequence_id, name) DO NOTHING",
        (
            sequence_id,
            session,
            topic.name,
            topic.ontology.tag,
            topic.ontology.serialization_format.value,
            topic.ontology.fingerprint,
            topic.schema.serialize().to_pybytes(),
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


def _sessions(db: sqlite3.Connection, sequence_id: int) -> tuple[str, ...]:
    rows = db.execute("SELECT id FROM sessions WHERE sequence_id = ? ORDER BY id", (sequence_id,))
    return tuple(row["id"] for row in rows)


def _types(db: sqlite3.Connection, sequence_id: int) -> dict[str, OntologyType]:
    rows = db.execute("SELECT * FROM topics WHERE sequence_id = ?", (sequence_id,))
    return {row["name"]: ontology_of(row) for row in rows}


def ontology_of(row: sqlite3.Row) -> OntologyType:
    """Return the type a row of `topics` describes."""
    columns = list(pa.ipc.read_schema(pa.py_buffer(row["arrow_schema"])))[1:]
    return OntologyType(
        row["ontology_tag"], pa.struct(columns), SerializationFormat(row["serialization_format"])
    )


def changed(sequence: str) -> SinkError:
    """Return the error for a sequence that is not what it was when the session began."""
    return SinkError("another run changed the sequence meanwhile", where=sequence, hint="run again")
