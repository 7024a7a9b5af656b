"""This file is the store as a whole: open, query, read, delete, collect garbage."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import pyarrow as pa

from mosaico_ingest import wire
from mosaico_ingest.diagnostics import offered
from mosaico_ingest.errors import SinkError
from mosaico_ingest.frozen import frozen
from mosaico_ingest.remote.path import AnyPath, RemotePath, as_path
from mosaico_ingest.store.catalog import Catalog
from mosaico_ingest.store.entries import NewNote
from mosaico_ingest.store.faults import NotInStore, explained
from mosaico_ingest.store.layout import Layout
from mosaico_ingest.store.model import Collected, SequenceInfo, TopicInfo
from mosaico_ingest.store.scan import Window, scan
from mosaico_ingest.store.seams import Files, Records

__all__ = ["Store"]

_GRACE_S = 10.0


@frozen
class Store:
    """A folder of Parquet segments and the catalog that says what they are; made by `Store.open`."""

    layout: Files
    catalog: Records

    @classmethod
    def open(cls, path: str | AnyPath, *, create: bool = True) -> Store:
        """Open the store in the folder or behind the URL `path`; it is made where there is none, unless `create` is off.

        Raises:
            SinkError: There is no store, it cannot be written, or a newer version made it.
        """
        place = as_path(path)
        if isinstance(place, RemotePath):
            from mosaico_ingest.store.bucket import Bucket  # noqa: PLC0415 - only stores behind URLs need it
            from mosaico_ingest.store.documents import Documents  # noqa: PLC0415 - the same

            bucket = Bucket(place)
            return cls(bucket, Documents(bucket, create=create))
        layout = Layout(place)
        return cls(layout, Catalog(layout.catalog, create=create))

    @classmethod
    def find(cls, path: AnyPath) -> Store | None:
        """Open the store in a folder or behind a URL; None where there is none."""
        if isinstance(path, RemotePath):
            from mosaico_ingest.store.bucket import Bucket  # noqa: PLC0415 - only stores behind URLs need it

            is_there = Bucket(path).is_there()
        else:
            is_there = Layout(path).catalog.is_file()
        return cls.open(path, create=False) if is_there else None

    @property
    def path(self) -> AnyPath:
        """The folder."""
        return self.layout.root

    def sequences(self) -> tuple[SequenceInfo, ...]:
        """Return every sequence, by name."""
        return self.catalog.sequences()

    def names(self) -> tuple[str, ...]:
        """Return the names of all sequences, sorted."""
        return tuple(self.catalog.names())

    def bounds(self, topic: TopicInfo, columns: Collection[str]) -> dict[AnyPath, dict[str, tuple[Any, Any]]]:
        """Return the smallest and largest value of columns, as `pose.x`, by segment, where they are known."""
        return self.catalog.bounds(topic, columns)

    def find_sequence(self, name: str) -> SequenceInfo | None:
        """Return one sequence, None where there is none of that name."""
        return self.catalog.sequence(name)

    def sequence(self, name: str) -> SequenceInfo:
        """Return one sequence.

        Raises:
            SinkError: There is none of that name; the error lists those there are.
        """
        info = self.catalog.sequence(name)
        if info is None:
            known = self.catalog.names()
            raise NotInStore(
                f"there is no sequence {name!r}", where=str(self.path), hint=offered(known, [name])
            )
        return info

    def topic(self, sequence: str, topic: str) -> TopicInfo:
        """Return one topic; its leading slash may be left out.

        Raises:
            SinkError: There is none of that name; the error lists those there are.
        """
        topics = {info.name: info for info in self.sequence(sequence).topics}
        name = f"/{topic.removeprefix('/')}"
        if name not in topics:
            raise NotInStore(f"there is no topic {name!r}", where=sequence, hint=offered(topics, [name]))
        return topics[name]

    def create_sequence(self, sequence: str, metadata: Mapping[str, Any]) -> None:
        """Enter a sequence that sessions will be added to; a `StoreSink` does it with its first session.

        Raises:
            SequenceExists: There is one of that name.
            SinkError: The name or the metadata is refused.
        """
        described = wire.check_metadata(metadata, where=sequence)
        self.catalog.create(wire.check_sequence_name(sequence), described)

    def add_note(self, sequence: str, message: str, *, topic: str | None = None) -> None:
        """Attach an error to a sequence, or to one of its topics."""
        self.catalog.note(sequence, NewNote(topic, message, time.time_ns()))

    def delete_notes(self, sequence: str, *, topic: str | None = None) -> None:
        """Remove the notes of a sequence itself, or those of one topic."""
        self.catalog.delete_notes(sequence, topic)

    def paths(self, sequence: str, topic: str) -> tuple[AnyPath, ...]:
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
        self._remove(self.catalog.delete_sequence(sequence))

    def delete_topic(self, sequence: str, topic: str) -> None:
        """Remove one topic; SinkError where there is none."""
        self._remove(self.catalog.delete_topic(sequence, f"/{topic.removeprefix('/')}"))

    def delete_session(self, sequence: str, session: str) -> None:
        """Remove what one session added; SinkError where there is none."""
        self._remove(self.catalog.delete_session(sequence, session))

    def collect_garbage(self, *, grace_s: float = _GRACE_S) -> Collected:
        """Remove what crashed writers and interrupted deletions left; live sessions are not touched.

        A staging folder younger than `grace_s` may belong to a session that is about to take its lock.
        """
        with explained(self.path):
            files = list(self.layout.segment_files())
            sessions = self.layout.open_sessions()
            live = {session for session in sessions if self.layout.in_use(session, grace_s)}
            known = self.catalog.forget(live)
            orphans = [file for file in files if self._is_orphan(file, known, live)]
            dead = sorted(set(sessions) - live)
            staged = [file for session in dead for file in self.layout.staged_files(session)]
            stored_bytes = sum(file.stat().st_size for file in (*orphans, *staged))
            self.layout.remove(orphans)
            for session in dead:
                self.layout.discard(session)
        return Collected(len(dead), len(orphans) + len(staged), stored_bytes)

    def _remove(self, paths: Iterable[str]) -> None:
        self.layout.remove(self.path / path for path in paths)

    def _is_orphan(self, file: AnyPath, known: set[str], live: set[str]) -> bool:
        return self.layout.relative(file) not in known and file.name.partition("-")[0] not in live


def _chosen(schema: pa.Schema, columns: Sequence[str], *, where: str) -> pa.Schema:
    unknown = [name for name in columns if name not in schema.names]
    if unknown:
        raise SinkError(
            f"there is no column {unknown[0]!r}", where=where, hint=offered(schema.names, unknown[:1])
        )
    wanted = dict.fromkeys([schema.names[0], *columns])
    return pa.schema([schema.field(name) for name in wanted])
