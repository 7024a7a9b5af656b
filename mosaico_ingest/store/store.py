"""This file is the store as a whole: open it, ask what is in it, read it, remove from it, tidy it."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from mosaico_ingest import wire
from mosaico_ingest.errors import SinkError
from mosaico_ingest.store import entries, queries, removal
from mosaico_ingest.store.catalog import Catalog
from mosaico_ingest.store.faults import NotInStore, explained
from mosaico_ingest.store.layout import Layout
from mosaico_ingest.store.lease import is_live
from mosaico_ingest.store.model import Collected, SequenceInfo, TopicInfo
from mosaico_ingest.store.scan import Window, scan

__all__ = ["Store"]

_GRACE_S = 10.0


@dataclass(frozen=True, slots=True)
class Store:
    """A folder of Parquet segments and the catalog that says what they are; made by `Store.open`."""

    layout: Layout
    catalog: Catalog

    @classmethod
    def open(cls, path: str | Path, *, create: bool = True) -> Store:
        """Open the store in the folder `path`; it is made where there is none, unless `create` is off.

        Raises:
            SinkError: There is no store, it cannot be written, or a newer version made it.
        """
        layout = Layout(Path(path))
        return cls(layout, Catalog(layout.catalog, create=create))

    @property
    def path(self) -> Path:
        """The folder."""
        return self.layout.root

    def sequences(self) -> tuple[SequenceInfo, ...]:
        """Return every sequence, by name."""
        with self.catalog.read() as db:
            found = (queries.sequence(db, name, self.path) for name in queries.names(db))
            return tuple(info for info in found if info is not None)

    def names(self) -> tuple[str, ...]:
        """Return the names of all sequences, sorted."""
        with self.catalog.read() as db:
            return tuple(queries.names(db))

    def bounds(self, topic: TopicInfo, columns: Collection[str]) -> dict[Path, dict[str, tuple[Any, Any]]]:
        """Return the smallest and largest value of columns, as `pose.x`, by segment, where they are known."""
        with self.catalog.read() as db:
            return queries.bounds(db, topic, columns, self.path)

    def sequence(self, name: str) -> SequenceInfo:
        """Return one sequence.

        Raises:
            SinkError: There is none of that name; the error lists those there are.
        """
        with self.catalog.read() as db:
            info = queries.sequence(db, name, self.path)
            known = queries.names(db) if info is None else []
        if info is None:
            raise NotInStore(f"there is no sequence {name!r}", where=str(self.path), hint=_listed(known))
        return info

    def topic(self, sequence: str, topic: str) -> TopicInfo:
        """Return one topic; its leading slash may be left out.

        Raises:
            SinkError: There is none of that name; the error lists those there are.
        """
        topics = {info.name: info for info in self.sequence(sequence).topics}
        name = f"/{topic.removeprefix('/')}"
        if name not in topics:
            raise NotInStore(f"there is no topic {name!r}", where=sequence, hint=_listed(list(topics)))
        return topics[name]

    def create_sequence(self, sequence: str, metadata: Mapping[str, Any]) -> None:
        """Enter a sequence that sessions will be added to; a `StoreSink` does it with its first session.

        Raises:
            SequenceExists: There is one of that name.
            SinkError: The name or the metadata is refused.
        """
        described = wire.check_metadata(metadata, where=sequence)
        with self.catalog.write() as db:
            entries.create(db, wire.check_sequence_name(sequence), described)

    def add_note(self, sequence: str, message: str, *, topic: str | None = None) -> None:
        """Attach an error to a sequence, or to one of its topics."""
        with self.catalog.write() as db:
            entries.note(db, sequence, entries.NewNote(topic, message, time.time_ns()))

    def delete_notes(self, sequence: str, *, topic: str | None = None) -> None:
        """Remove the notes of a sequence itself, or those of one topic."""
        with self.catalog.write() as db:
            removal.notes(db, sequence, topic)

    def paths(self, sequence: str, topic: str) -> tuple[Path, ...]:
        """Return the Parquet files of a topic, each sorted by `timestamp_ns`."""
        return tuple(segment.path for segment in self.topic(sequence, topic).segments)

    def scan(
        self,
        sequence: str,
        topic: str,
        *,
        start_ns: int | None = None,
        end_ns: int | None = None,
        columns: Sequence[str] | None = None,
    ) -> pa.RecordBatchReader:
        """Read a topic's rows sorted by `timestamp_ns`, from `start_ns` up to but without `end_ns`.

        `columns` names top-level columns; `timestamp_ns` always comes, and comes first.
        """
        info = self.topic(sequence, topic)
        schema = info.schema
        if columns is not None:
            schema = _chosen(schema, columns, where=f"{sequence}{info.name}")
        return pa.RecordBatchReader.from_batches(
            schema, scan(info.segments, schema, Window(start_ns, end_ns))
        )

    def delete_sequence(self, sequence: str) -> None:
        """Remove a sequence with all it holds; SinkError where there is none."""
        with self.catalog.write() as db:
            paths = removal.sequence(db, sequence)
        self.layout.remove(self.path / path for path in paths)

    def delete_topic(self, sequence: str, topic: str) -> None:
        """Remove one topic; SinkError where there is none."""
        with self.catalog.write() as db:
            paths = removal.topic(db, sequence, f"/{topic.removeprefix('/')}")
        self.layout.remove(self.path / path for path in paths)

    def delete_session(self, sequence: str, session: str) -> None:
        """Remove what one session added; SinkError where there is none."""
        with self.catalog.write() as db:
            paths = removal.session(db, sequence, session)
        self.layout.remove(self.path / path for path in paths)

    def collect_garbage(self, *, grace_s: float = _GRACE_S) -> Collected:
        """Remove what crashed writers and interrupted deletions left; live sessions are not touched.

        A staging folder younger than `grace_s` may belong to a session that is about to take its lock.
        """
        with explained(self.path):
            files = list(self.layout.segment_files())
            sessions = self.layout.open_sessions()
            live = {session for session in sessions if self._in_use(session, grace_s)}
            with self.catalog.write() as db:
                known = removal.forget(db, live)
            orphans = [file for file in files if self._is_orphan(file, known, live)]
            dead = sorted(set(sessions) - live)
            staged = [file for session in dead for file in self.layout.staged_files(session)]
            stored_bytes = sum(file.stat().st_size for file in (*orphans, *staged))
            self.layout.remove(orphans)
            for session in dead:
                self.layout.discard(session)
        return Collected(len(dead), len(orphans) + len(staged), stored_bytes)

    def _in_use(self, session: str, grace_s: float) -> bool:
        folder = self.layout.session(session)
        young = folder.exists() and time.time() - folder.stat().st_mtime < grace_s
        return young or is_live(self.layout.lock(session))

    def _is_orphan(self, file: Path, known: set[str], live: set[str]) -> bool:
        return self.layout.relative(file) not in known and file.name.partition("-")[0] not in live


def _chosen(schema: pa.Schema, columns: Sequence[str], *, where: str) -> pa.Schema:
    unknown = [name for name in columns if name not in schema.names]
    if unknown:
        raise SinkError(f"there is no column {unknown[0]!r}", where=where, hint=_listed(schema.names))
    wanted = dict.fromkeys([schema.names[0], *columns])
    return pa.schema([schema.field(name) for name in wanted])


def _listed(known: Sequence[str]) -> str:
    return f"there are {', '.join(known)}" if known else "there are none"
