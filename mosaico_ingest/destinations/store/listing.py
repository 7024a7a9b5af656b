"""Pages of a store's sequences: the filter, the summary of a sequence, and the queries of the SQLite catalog."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Collection, Mapping
from fnmatch import fnmatchcase
from typing import Any

from msgspec import Struct

from mosaico_ingest.destinations.base import FamilyTopic
from mosaico_ingest.destinations.store.model import Note, SequenceInfo, reason_incomplete
from mosaico_ingest.job.values import PROVENANCE_KEY


class SequenceFilter(Struct, frozen=True):
    """Which sequences a listing contains."""

    match: str | None = None
    """A glob for the names, with `*`, `?` and `[…]`."""
    metadata: Mapping[str, str] = {}
    """Values by key; `vehicle.id` is the key `id` inside of `vehicle`. Values are compared as text, as in JSON."""
    incomplete: bool = False
    """Select only sequences whose last run ended with an error, or that no run finished."""

    def selects(self, info: SequenceInfo | SequenceSummary) -> bool:
        """Return whether a sequence passes the filter; catalogs that cannot query use this method."""
        return (
            (self.match is None or fnmatchcase(info.name, self.match))
            and (not self.incomplete or info.incomplete is not None)
            and all(_text_at(info.metadata, key) == value for key, value in self.metadata.items())
        )


class SequenceSummary(Struct, frozen=True):
    """The counts of one sequence, without its topics."""

    name: str
    metadata: Mapping[str, Any]
    topics: int
    rows: int
    stored_bytes: int
    start_ns: int | None
    """The smallest time stamp, or None without rows."""
    end_ns: int | None
    """The largest time stamp, inclusive, or None without rows."""
    incomplete: str | None
    """See `SequenceInfo.incomplete`."""
    notes: tuple[Note, ...]

    @classmethod
    def of(cls, info: SequenceInfo) -> SequenceSummary:
        """Return the summary of a complete entry."""
        return cls(
            info.name,
            info.metadata,
            len(info.topics),
            info.rows,
            info.stored_bytes,
            info.start_ns,
            info.end_ns,
            info.incomplete,
            info.notes,
        )


class Listing(Struct, frozen=True):
    """One page of a listing, sorted by name."""

    sequences: tuple[SequenceSummary, ...]
    total: int
    """Number of sequences that pass the filter, on all pages."""
    next_after: str | None
    """The `after` of the next page, or None for the last page."""


def listing(
    db: sqlite3.Connection, selection: SequenceFilter, *, after: str | None, limit: int | None
) -> Listing:
    """Return the sequences after the name `after`, at most `limit`; the cost is that of the page and the count."""
    db.create_function("matches", 2, fnmatchcase, deterministic=True)  # GLOB treats brackets differently
    where, values = _conditions(selection)
    total = db.execute(f"SELECT count(*) FROM sequences WHERE {where}", values).fetchone()[0]  # noqa: S608 - `where` contains constants of this module and placeholders
    page = db.execute(
        f"SELECT id, name, metadata FROM sequences WHERE {where} AND name > :after ORDER BY name LIMIT :limit",  # noqa: S608 - `where` contains constants of this module and placeholders
        {**values, "after": after or "", "limit": -1 if limit is None else limit + 1},
    ).fetchall()
    more = limit is not None and len(page) > limit
    rows = page[:limit]
    return Listing(
        tuple(_summary(db, row) for row in rows), total, rows[-1]["name"] if more and rows else None
    )


def family_topics(
    db: sqlite3.Connection, family: str | None, names: Collection[str]
) -> tuple[FamilyTopic, ...]:
    """Return the topics with these names that sessions of the family created, oldest session first."""
    rows = db.execute(
        "SELECT sequences.name AS sequence, topics.name AS name, topics.metadata AS metadata FROM topics"
        " JOIN sequences ON sequences.id = topics.sequence_id JOIN sessions ON sessions.id = topics.session_id"
        " WHERE topics.name IN (SELECT value FROM json_each(:names))"
        " AND json_extract(sessions.metadata, :path) IS :family ORDER BY topics.session_id",
        {"names": json.dumps(list(names)), "path": f"$.{PROVENANCE_KEY}.family", "family": family},
    )
    return tuple(FamilyTopic(row["sequence"], row["name"], json.loads(row["metadata"])) for row in rows)


def _conditions(selection: SequenceFilter) -> tuple[str, dict[str, str]]:
    conditions, values = ["1"], dict[str, str]()
    if selection.match is not None:
        conditions.append("matches(name, :match)")
        values["match"] = selection.match
    if selection.incomplete:
        conditions.append(
            "(NOT EXISTS (SELECT 1 FROM sessions WHERE sequence_id = sequences.id)"
            " OR EXISTS (SELECT 1 FROM notes WHERE sequence_id = sequences.id AND topic IS NULL))"
        )
    for number, (key, value) in enumerate(selection.metadata.items()):
        path = f":path{number}"
        conditions.append(
            f"CASE json_type(metadata, {path}) WHEN 'true' THEN 'true' WHEN 'false' THEN 'false' WHEN 'null' THEN 'null'"
            f" ELSE CAST(json_extract(metadata, {path}) AS TEXT) END = :value{number}"
        )
        values[f"path{number}"] = "$" + "".join(f".{json.dumps(part)}" for part in key.split("."))
        values[f"value{number}"] = value
    return " AND ".join(conditions), values


def _summary(db: sqlite3.Connection, row: sqlite3.Row) -> SequenceSummary:
    topics, rows, stored_bytes, start_ns, end_ns = db.execute(
        "SELECT count(DISTINCT topics.id), coalesce(sum(rows), 0), coalesce(sum(bytes), 0), min(start_ns), max(end_ns)"
        " FROM topics LEFT JOIN segments ON topic_id = topics.id WHERE sequence_id = ?",
        (row["id"],),
    ).fetchone()
    notes = tuple(
        Note(note["topic"], note["message"], note["created_ns"])
        for note in db.execute("SELECT * FROM notes WHERE sequence_id = ? ORDER BY id", (row["id"],))
    )
    has_session = db.execute("SELECT 1 FROM sessions WHERE sequence_id = ?", (row["id"],)).fetchone()
    incomplete = reason_incomplete(notes, has_session=has_session is not None)
    metadata = json.loads(row["metadata"])
    return SequenceSummary(
        row["name"], metadata, topics, rows, stored_bytes, start_ns, end_ns, incomplete, notes
    )


def _text_at(metadata: Mapping[str, Any], key: str) -> str | None:
    """Return the value at a dotted key as text, or None if the metadata has no such key."""
    value: Any = metadata
    for part in key.split("."):
        if not isinstance(value, Mapping) or part not in value:
            return None
        value = value[part]
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"), ensure_ascii=False)
