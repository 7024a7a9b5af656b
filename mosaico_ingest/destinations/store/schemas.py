"""The Arrow schemas of a SQLite catalog: topics with equal columns share one stored schema.

Catalogs of format 1 store a copy of its schema with each topic. They are readable, and the first process that opens one
for writing converts it.
"""

from __future__ import annotations

import sqlite3
from functools import lru_cache

import pyarrow as pa
from xxhash import xxh3_128_hexdigest

from mosaico_ingest.caching import cache_by_identity

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
