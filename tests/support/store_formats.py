"""Stores in earlier formats."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path


def make_format_1(root: Path) -> None:
    """Convert the catalog of the store to its first version of format 1.

    Each topic has its own schema, and segments have neither checksums nor merged sessions.
    """
    with closing(sqlite3.connect(root / "catalog.sqlite")) as db:
        db.executescript(
            """
            PRAGMA foreign_keys = OFF;
            PRAGMA legacy_alter_table = ON; -- keeps the references of other tables
            DROP INDEX topics_of_schema;
            ALTER TABLE topics RENAME TO current;
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
            INSERT INTO topics SELECT id, sequence_id, session_id, name, ontology_tag, serialization_format, fingerprint,
                arrow_schema, metadata, created_ns FROM current JOIN schemas ON digest = schema_digest;
            DROP TABLE current;
            DROP TABLE schemas;
            ALTER TABLE segments DROP COLUMN checksum;
            ALTER TABLE segments DROP COLUMN merged;
            PRAGMA user_version = 1;
            """
        )
