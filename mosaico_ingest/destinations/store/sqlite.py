"""SQLite catalogs: connections, the table of Arrow schemas, and the queries of pages.

Topics with equal columns share one stored schema. Catalogs of format 1 store a copy of its schema with each topic. They
are readable, and the first process that opens one for writing converts it.
"""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Callable, Collection, Generator
from contextlib import closing, contextmanager
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from threading import Lock

import pyarrow as pa
from xxhash import xxh3_128_hexdigest

from mosaico_ingest.destinations import FamilyTopic
from mosaico_ingest.destinations.store.model import (
    Listing,
    Note,
    SequenceFilter,
    SequenceSummary,
    reason_incomplete,
)
from mosaico_ingest.job.values import PROVENANCE_KEY
from mosaico_ingest.lazy import cache_by_identity

BUSY_S = 30.0
"""Seconds that a call waits for other writers."""


def connect(path: Path, query: str) -> sqlite3.Connection:
    """Open a connection; `query` holds the parameters of the file's URI."""
    uri = f"{path.absolute().as_uri()}?{query}"
    db = sqlite3.connect(uri, uri=True, timeout=BUSY_S, isolation_level=None, check_same_thread=False)
    try:
        db.row_factory = sqlite3.Row
        db.execute("PRAGMA foreign_keys = ON")
        db.execute("PRAGMA synchronous = FULL")
        db.execute("SELECT count(*) FROM sqlite_master")
    except sqlite3.Error:
        db.close()
        raise
    return db


class OpenCatalog:
    """The connections to one catalog file that calls reuse; each call has a connection for itself."""

    def __init__(self, path: Path) -> None:
        self.file = _identity(path)
        self.handles = 0
        self.is_current = False
        """Whether the tables have all columns of this version."""
        self._idle = [connect(path, "mode=rw")]

    @contextmanager
    def connection(self, path: Path) -> Generator[sqlite3.Connection, None, None]:
        """Yield a connection for reading and writing, and keep it unless the block fails."""
        try:
            db = self._idle.pop()
        except IndexError:
            db = connect(path, "mode=rw")
        try:
            yield db
        except BaseException:
            db.close()
            raise
        if self.handles:
            self._idle.append(db)
        else:
            db.close()

    def close(self) -> None:
        """Close all idle connections; the last one to close a catalog writes its log back."""
        while self._idle:
            self._idle.pop().close()


class Handle:
    """Keeps a catalog open until it is closed."""

    def __init__(self, key: tuple[int, str], catalog: OpenCatalog) -> None:
        self._key = key
        self._catalog: OpenCatalog | None = catalog

    def close(self) -> None:
        """Close the handle; a second call has no effect."""
        catalog, self._catalog = self._catalog, None
        if catalog is None or self._key[0] != os.getpid():
            return
        with _LOCK:
            catalog.handles -= 1
            if catalog.handles:
                return
            if _OPEN.get(self._key) is catalog:
                del _OPEN[self._key]
        catalog.close()


_OPEN: dict[tuple[int, str], OpenCatalog] = {}
"""The open catalogs by process and path: a forked process must not use the connections of its parent."""
_LOCK = Lock()


def keep_open(path: Path) -> Handle:
    """Keep a catalog open, so that calls need no new connection and closing one costs no checkpoint."""
    key = _key(path)
    with _LOCK:
        catalog = _OPEN.get(key)
        if catalog is None or catalog.file != _identity(path):
            catalog = _OPEN[key] = OpenCatalog(path)
        catalog.handles += 1
    return Handle(key, catalog)


def find_open(path: Path) -> OpenCatalog | None:
    """Return the open catalog of a path; None if there is none, or if another file has replaced it."""
    catalog = _OPEN.get(_key(path))
    if catalog is None:
        return None
    try:
        return catalog if catalog.file == _identity(path) else None
    except OSError:
        return None


@contextmanager
def connection(
    path: Path, open_connection: Callable[[], sqlite3.Connection]
) -> Generator[sqlite3.Connection, None, None]:
    """Yield a connection of the open catalog, or a new one, which is closed afterwards."""
    catalog = find_open(path)
    if catalog is not None:
        with catalog.connection(path) as db:
            yield db
        return
    with closing(open_connection()) as db:
        yield db


def _key(path: Path) -> tuple[int, str]:
    return os.getpid(), os.path.abspath(path)  # noqa: PTH100 - half the time of `Path.absolute`


def _identity(path: Path) -> tuple[int, int]:
    properties = path.stat()
    return properties.st_dev, properties.st_ino


TABLE = """
CREATE TABLE schemas (
    digest TEXT PRIMARY KEY,
    arrow_schema BLOB NOT NULL
);
CREATE INDEX topics_of_schema ON topics (schema_digest);
"""


def convert(db: sqlite3.Connection) -> None:
    """Convert the tables of format 1 inside a transaction: move the schema of each topic to the table of schemas."""
    db.execute("ALTER TABLE topics ADD COLUMN schema_digest TEXT")
    for statement in TABLE.split(";"):
        db.execute(statement)
    db.create_function("digest", 1, xxh3_128_hexdigest, deterministic=True)
    db.execute("INSERT OR IGNORE INTO schemas SELECT digest(arrow_schema), arrow_schema FROM topics")
    db.execute("UPDATE topics SET schema_digest = digest(arrow_schema)")
    db.execute("ALTER TABLE topics DROP COLUMN arrow_schema")


def store_schema(db: sqlite3.Connection, schema: pa.Schema) -> str:
    """Add a schema to the table unless an equal one is there, and return its digest."""
    digest, content = _serialized(schema)
    db.execute("INSERT OR IGNORE INTO schemas VALUES (?, ?)", (digest, content))
    return digest


def schema_of(db: sqlite3.Connection, topic: sqlite3.Row) -> pa.Schema:
    """Return the schema of a row of `topics`, in either format."""
    digest = topic["schema_digest"] if "schema_digest" in topic.keys() else None  # noqa: SIM118 - `in` searches the values of a row
    if digest is None:
        return _deserialized(topic["arrow_schema"])
    (content,) = db.execute("SELECT arrow_schema FROM schemas WHERE digest = ?", (digest,)).fetchone()
    return _deserialized(content)


def remove_unused(db: sqlite3.Connection) -> None:
    """Remove the schemas that no topic has."""
    db.execute(
        "DELETE FROM schemas WHERE digest NOT IN (SELECT schema_digest FROM topics WHERE schema_digest NOT NULL)"
    )


@cache_by_identity
def _serialized(schema: pa.Schema) -> tuple[str, bytes]:
    content = schema.serialize().to_pybytes()
    return xxh3_128_hexdigest(content), content


@lru_cache(maxsize=256)
def _deserialized(content: bytes) -> pa.Schema:
    return pa.ipc.read_schema(pa.py_buffer(content))


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
