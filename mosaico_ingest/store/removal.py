"""This file deletes from the catalog, and returns which files are no longer referenced."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection

from mosaico_ingest.store.faults import NotInStore

__all__ = ["forget", "notes", "sequence", "session", "topic"]


def sequence(db: sqlite3.Connection, name: str) -> list[str]:
    """Remove a sequence and return the paths of its segments."""
    owner = _sequence_id(db, name)
    paths = _paths(db, "topic_id IN (SELECT id FROM topics WHERE sequence_id = ?)", owner)
    db.execute("DELETE FROM sequences WHERE id = ?", (owner,))
    return paths


def topic(db: sqlite3.Connection, sequence_name: str, name: str) -> list[str]:
    """Remove a topic and return the paths of its segments."""
    owner = _sequence_id(db, sequence_name)
    row = db.execute("SELECT id FROM topics WHERE sequence_id = ? AND name = ?", (owner, name)).fetchone()
    if row is None:
        raise NotInStore(f"there is no topic {name!r}", where=sequence_name)
    paths = _paths(db, "topic_id = ?", row["id"])
    db.execute("DELETE FROM topics WHERE id = ?", (row["id"],))
    db.execute("DELETE FROM notes WHERE sequence_id = ? AND topic = ?", (owner, name))
    return paths


def session(db: sqlite3.Connection, sequence_name: str, session_id: str) -> list[str]:
    """Remove a session, with the topics only it wrote to, and return the paths of its segments."""
    owner = _sequence_id(db, sequence_name)
    paths = _paths(db, "session_id = ?", session_id)
    if not db.execute("DELETE FROM sessions WHERE id = ? AND sequence_id = ?", (session_id, owner)).rowcount:
        raise NotInStore(f"there is no session {session_id!r}", where=sequence_name)
    db.execute(
        "DELETE FROM topics WHERE session_id = ? AND id NOT IN (SELECT topic_id FROM segments)", (session_id,)
    )
    return paths


def notes(db: sqlite3.Connection, sequence_name: str, topic_name: str | None) -> None:
    """Remove the notes of a sequence, or those of one of its topics."""
    owner = _sequence_id(db, sequence_name)
    db.execute("DELETE FROM notes WHERE sequence_id = ? AND topic IS ?", (owner, topic_name))


def forget(db: sqlite3.Connection, live: Collection[str]) -> set[str]:
    """Remove the reservations of sessions that are not live and return the paths of all segments."""
    for row in db.execute("SELECT session_id FROM reservations").fetchall():
        if row["session_id"] not in live:
            db.execute("DELETE FROM reservations WHERE session_id = ?", (row["session_id"],))
    return set(_paths(db, "?", 1))


def _sequence_id(db: sqlite3.Connection, name: str) -> int:
    row = db.execute("SELECT id FROM sequences WHERE name = ?", (name,)).fetchone()
    if row is None:
        raise NotInStore(f"there is no sequence {name!r}")
    return int(row["id"])


def _paths(db: sqlite3.Connection, condition: str, value: int | str) -> list[str]:
    rows = db.execute(f"SELECT path FROM segments WHERE {condition}", (value,))  # noqa: S608 - the conditions are the constants above
    return [row["path"] for row in rows]
