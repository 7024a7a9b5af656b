"""This file asks the catalog what there is."""

from __future__ import annotations

import json
import sqlite3
from collections import defaultdict
from collections.abc import Collection
from pathlib import Path
from typing import Any

import pyarrow as pa

from mosaico_ingest.remote.path import AnyPath
from mosaico_ingest.store.entries import ontology_of
from mosaico_ingest.store.model import Note, SegmentInfo, SequenceInfo, SessionInfo, TopicInfo

__all__ = ["bounds", "names", "sequence"]


def names(db: sqlite3.Connection) -> list[str]:
    """Return the names of all sequences, sorted."""
    return [row["name"] for row in db.execute("SELECT name FROM sequences ORDER BY name")]


def sequence(db: sqlite3.Connection, name: str, root: Path) -> SequenceInfo | None:
    """Return all that is known of a sequence, None where it does not exist."""
    row = db.execute("SELECT * FROM sequences WHERE name = ?", (name,)).fetchone()
    if row is None:
        return None
    return SequenceInfo(
        name=name,
        metadata=json.loads(row["metadata"]),
        created_ns=row["created_ns"],
        sessions=_sessions(db, row["id"]),
        topics=_topics(db, row["id"], name, root),
        notes=_notes(db, row["id"]),
    )


def bounds(
    db: sqlite3.Connection, topic: TopicInfo, columns: Collection[str], root: Path
) -> dict[AnyPath, dict[str, tuple[Any, Any]]]:
    """Return the known bounds of the columns asked for, by the path of the segment."""
    found: dict[AnyPath, dict[str, tuple[Any, Any]]] = defaultdict(dict)
    rows = db.execute(
        "SELECT path, column_path, low, high FROM bounds JOIN segments ON segments.id = segment_id"
        " JOIN topics ON topics.id = topic_id JOIN sequences ON sequences.id = sequence_id"
        " WHERE sequences.name = ? AND topics.name = ?",
        (topic.sequence, topic.name),
    )
    for row in rows:
        if row["column_path"] in columns:
            found[root / row["path"]][row["column_path"]] = (row["low"], row["high"])
    return found


def _sessions(db: sqlite3.Connection, sequence_id: int) -> tuple[SessionInfo, ...]:
    rows = db.execute("SELECT * FROM sessions WHERE sequence_id = ? ORDER BY id", (sequence_id,))
    return tuple(
        SessionInfo(row["id"], json.loads(row["metadata"]), row["created_ns"], row["completed_ns"])
        for row in rows
    )


def _topics(db: sqlite3.Connection, sequence_id: int, name: str, root: Path) -> tuple[TopicInfo, ...]:
    segments = _segments(db, sequence_id, root)
    rows = db.execute("SELECT * FROM topics WHERE sequence_id = ? ORDER BY name", (sequence_id,))
    return tuple(
        TopicInfo(
            sequence=name,
            name=row["name"],
            session=row["session_id"],
            ontology=ontology_of(row),
            schema=pa.ipc.read_schema(pa.py_buffer(row["arrow_schema"])),
            metadata=json.loads(row["metadata"]),
            created_ns=row["created_ns"],
            segments=tuple(segments[row["id"]]),
        )
        for row in rows
    )


def _segments(db: sqlite3.Connection, sequence_id: int, root: Path) -> dict[int, list[SegmentInfo]]:
    found: dict[int, list[SegmentInfo]] = defaultdict(list)
    rows = db.execute(
        "SELECT segments.* FROM segments JOIN topics ON topics.id = topic_id WHERE sequence_id = ?"
        " ORDER BY start_ns, segments.session_id, path",
        (sequence_id,),
    )
    for row in rows:
        found[row["topic_id"]].append(
            SegmentInfo(
                path=root / row["path"],
                session=row["session_id"],
                rows=row["rows"],
                stored_bytes=row["bytes"],
                start_ns=row["start_ns"],
                end_ns=row["end_ns"],
                checksum=row["checksum"] if "checksum" in row.keys() else None,  # noqa: SIM118 - `in` would look among its values
            )
        )
    return found


def _notes(db: sqlite3.Connection, sequence_id: int) -> tuple[Note, ...]:
    rows = db.execute("SELECT * FROM notes WHERE sequence_id = ? ORDER BY id", (sequence_id,))
    return tuple(Note(row["topic"], row["message"], row["created_ns"]) for row in rows)
