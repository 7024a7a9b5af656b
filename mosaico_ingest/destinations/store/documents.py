"""The documents of a catalog behind a URL, and their snapshot.

A snapshot is a cache that needs no agreement with writers: a row is valid while the object store lists its document with the
same size and the same time of change. Documents that changed later, or that the snapshot lacks, are read one by one. A
snapshot that is out of date, lost or written by several processes at the same time is therefore slow at worst.
"""

from __future__ import annotations

import json
from base64 import b64decode, b64encode
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from msgspec import Struct
from pydantic import BaseModel, ConfigDict

from mosaico_ingest.destinations.base import check_same_type, sequence_exists
from mosaico_ingest.destinations.store.files import (
    NotInStore,
    sequence_changed,
    translate_errors,
)
from mosaico_ingest.destinations.store.model import (
    Claim,
    MergedSegment,
    NewNote,
    NewSession,
    NewTopic,
    Note,
    Replacement,
    SegmentInfo,
    SequenceInfo,
    SessionInfo,
    TopicInfo,
    attachments_of,
    check_not_merged,
)
from mosaico_ingest.destinations.store.segment import Segment
from mosaico_ingest.errors import IngestError
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.ontology.registry import OntologyType, SerializationFormat
from mosaico_ingest.remote import RemotePath

FORMAT = 1
"""The version of the documents; it increases if earlier releases cannot read them."""


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class SegmentEntry(_Part):
    """One Parquet file."""

    path: str
    session: str
    rows: int
    bytes: int
    start_ns: int
    end_ns: int
    checksum: str | None = None
    bounds: tuple[tuple[str, Any, Any], ...] = ()
    """Path, smallest and largest value of each column with an order."""
    merged: tuple[tuple[str, str | None], ...] = ()
    """Session and checksum of each segment that compaction merged into this one."""

    @property
    def merged_segments(self) -> tuple[MergedSegment, ...]:
        """The segments that compaction merged into this one."""
        return tuple(MergedSegment(session, checksum) for session, checksum in self.merged)


class TopicEntry(_Part):
    """One topic and its segments."""

    name: str
    session: str
    ontology_tag: str
    serialization_format: SerializationFormat
    arrow_schema: str
    """An Arrow IPC schema message, in Base64."""
    metadata: dict[str, Any]
    created_ns: int
    segments: tuple[SegmentEntry, ...]

    @property
    def columns(self) -> pa.Schema:
        """Its columns."""
        return pa.ipc.read_schema(pa.py_buffer(b64decode(self.arrow_schema)))

    @property
    def ontology(self) -> OntologyType:
        """Its type."""
        return OntologyType(self.ontology_tag, pa.struct(list(self.columns)[1:]), self.serialization_format)


class SessionEntry(_Part):
    """A committed session."""

    id: str
    metadata: dict[str, Any]
    created_ns: int
    completed_ns: int


class NoteEntry(_Part):
    """An attached error."""

    topic: str | None
    message: str
    created_ns: int


class SequenceDocument(_Part):
    """One sequence."""

    format: int = FORMAT
    name: str
    metadata: dict[str, Any]
    created_ns: int
    sessions: tuple[SessionEntry, ...] = ()
    topics: tuple[TopicEntry, ...] = ()
    notes: tuple[NoteEntry, ...] = ()

    @property
    def session_ids(self) -> tuple[str, ...]:
        """Its sessions, sorted."""
        return tuple(sorted(session.id for session in self.sessions))

    @property
    def types(self) -> dict[str, OntologyType]:
        """The types of its topics."""
        return {topic.name: topic.ontology for topic in self.topics}

    @property
    def paths(self) -> list[str]:
        """The paths of all its segments."""
        return [segment.path for topic in self.topics for segment in topic.segments]

    def info(self, root: RemotePath) -> SequenceInfo:
        """Return the sequence as the model of the catalog."""
        sessions = tuple(
            SessionInfo(one.id, one.metadata, one.created_ns, one.completed_ns)
            for one in sorted(self.sessions, key=lambda one: one.id)
        )
        return SequenceInfo(
            name=self.name,
            metadata=self.metadata,
            created_ns=self.created_ns,
            sessions=sessions,
            attachments=attachments_of(sessions, root),
            topics=tuple(
                self._topic(topic, root) for topic in sorted(self.topics, key=lambda topic: topic.name)
            ),
            notes=tuple(Note(one.topic, one.message, one.created_ns) for one in self.notes),
        )

    def with_session(self, new: NewSession, *, completed_ns: int) -> SequenceDocument:
        """Return the sequence with the content of a new session."""
        entry = SessionEntry(
            id=new.id, metadata=json.loads(new.metadata), created_ns=new.created_ns, completed_ns=completed_ns
        )
        topics = {topic.name: topic for topic in self.topics}
        for topic in new.topics:
            topics[topic.name] = _joined(topics.get(topic.name), new.id, topic)
        return self.model_copy(
            update={
                "sessions": (*self.sessions, entry),
                "topics": tuple(topics.values()),
                "notes": (*self.notes, *map(_note, new.notes)),
            }
        )

    def with_replacement(self, change: Replacement) -> SequenceDocument | None:
        """Return the sequence with a merged segment, or None if one of the segments it replaces is gone."""
        document = next((topic for topic in self.topics if topic.name == change.topic), None)
        if document is None or not {one.path for one in document.segments}.issuperset(change.replaced):
            return None
        merged = _entry(change.session, change.path, change.segment).model_copy(
            update={"merged": tuple((part.session, part.checksum) for part in change.merged)}
        )
        remaining = tuple(one for one in document.segments if one.path not in change.replaced)
        changed = document.model_copy(update={"segments": (*remaining, merged)})
        topics = tuple(changed if topic is document else topic for topic in self.topics)
        return self.model_copy(update={"topics": topics})

    def with_note(self, new: NewNote) -> SequenceDocument:
        """Return the sequence with a new note."""
        return self.model_copy(update={"notes": (*self.notes, _note(new))})

    def without_notes(self, topic: str | None) -> SequenceDocument:
        """Return the sequence without its own notes, or without the notes of a topic."""
        return self.model_copy(update={"notes": tuple(one for one in self.notes if one.topic != topic)})

    def without_topic(self, name: str) -> SequenceDocument:
        """Return the sequence without a topic; raises NotInStore if the topic does not exist."""
        rest = tuple(topic for topic in self.topics if topic.name != name)
        if len(rest) == len(self.topics):
            raise NotInStore(f"there is no topic {name!r}", where=self.name)
        return self.without_notes(name).model_copy(update={"topics": rest})

    def without_session(self, session: str) -> SequenceDocument:
        """Return the sequence without the content of a session; raises NotInStore if the session does not exist."""
        rest = tuple(one for one in self.sessions if one.id != session)
        if len(rest) == len(self.sessions):
            raise NotInStore(f"there is no session {session!r}", where=self.name)
        check_not_merged(
            session, self.name, (one.merged_segments for each in self.topics for one in each.segments)
        )
        topics = (
            topic.model_copy(
                update={"segments": tuple(one for one in topic.segments if one.session != session)}
            )
            for topic in self.topics
        )
        remaining = tuple(topic for topic in topics if topic.segments or topic.session != session)
        return self.model_copy(update={"sessions": rest, "topics": remaining})

    def _topic(self, topic: TopicEntry, root: RemotePath) -> TopicInfo:
        segments = sorted(topic.segments, key=lambda one: (one.start_ns, one.session, one.path))
        return TopicInfo(
            sequence=self.name,
            name=topic.name,
            session=topic.session,
            ontology=topic.ontology,
            schema=topic.columns,
            metadata=topic.metadata,
            created_ns=topic.created_ns,
            segments=tuple(_segment(one, root) for one in segments),
        )


def check_unchanged(claimed: Claim, now: SequenceDocument | None) -> None:
    """Check that a sequence has not changed since the claim.

    Raises:
        SequenceExists: The sequence exists now, but must not exist.
        SinkError: Another session changed the sequence.
    """
    if now is not None and claimed.if_exists in {IfExists.FAIL, IfExists.SKIP}:
        raise sequence_exists(claimed.sequence)
    if claimed.sequence_id is not None and (now is None or now.created_ns != claimed.sequence_id):
        raise sequence_changed(claimed.sequence)
    if claimed.if_exists is IfExists.REPLACE and now is not None and now.session_ids != claimed.sessions:
        raise sequence_changed(claimed.sequence)


def _joined(held: TopicEntry | None, session: str, new: NewTopic) -> TopicEntry:
    added = tuple(_entries(session, new))
    if held is not None:
        check_same_type(held.ontology, new.ontology, where=new.name)
        return held.model_copy(update={"segments": (*held.segments, *added)})
    return TopicEntry(
        name=new.name,
        session=session,
        ontology_tag=new.ontology.tag,
        serialization_format=new.ontology.serialization_format,
        arrow_schema=b64encode(new.schema.serialize().to_pybytes()).decode(),
        metadata=json.loads(new.metadata),
        created_ns=new.created_ns,
        segments=added,
    )


def _entries(session: str, new: NewTopic) -> Iterator[SegmentEntry]:
    for path, segment in new.segments.items():
        yield _entry(session, path, segment)


def _entry(session: str, path: str, segment: Segment) -> SegmentEntry:
    return SegmentEntry(
        path=path,
        session=session,
        rows=segment.rows,
        bytes=segment.stored_bytes,
        start_ns=segment.start_ns,
        end_ns=segment.end_ns,
        checksum=segment.checksum,
        bounds=segment.bounds,
    )


def _segment(entry: SegmentEntry, root: RemotePath) -> SegmentInfo:
    return SegmentInfo(
        path=root / entry.path,
        session=entry.session,
        rows=entry.rows,
        stored_bytes=entry.bytes,
        start_ns=entry.start_ns,
        end_ns=entry.end_ns,
        checksum=entry.checksum,
        merged=entry.merged_segments,
    )


def _note(new: NewNote) -> NoteEntry:
    return NoteEntry(topic=new.topic, message=new.message, created_ns=new.created_ns)


SUMMARY, DOCUMENT = "summary", "document"
"""The columns with the content of a row."""
_FOLDER = "snapshots"
_FILE = "catalog-1.parquet"
"""The name contains the version of the columns."""
_SETTLED_NS = 5 * 10**9
"""Time since the last change after which a document may be in a snapshot; object stores list times in full seconds, so a
later change of the same second would not be visible."""
_GROUP_ROWS = 1000
_SCHEMA = pa.schema(
    [
        pa.field("key", pa.string()),
        pa.field("size", pa.int64()),
        pa.field("mtime_ns", pa.int64()),
        pa.field(SUMMARY, pa.binary()),
        pa.field(DOCUMENT, pa.binary()),
    ]
)


class Content(Struct, frozen=True):
    """The content of a row, as JSON."""

    summary: bytes
    document: bytes


def read_rows(root: RemotePath, column: str, documents: Mapping[str, RemotePath]) -> dict[str, bytes]:
    """Return a column of the snapshot for the listed documents that have not changed since; empty without a snapshot."""
    rows: dict[str, bytes] = {}
    for batch in _batches(root, ["key", "size", "mtime_ns", column]):
        selected = _unchanged(batch, documents)
        keys, values = batch.column("key").take(selected), batch.column(column).take(selected)
        rows.update(
            (str(key), value)
            for key, value in zip(keys.to_pylist(), values.to_pylist(), strict=True)
            if value is not None
        )
    return rows


def write_snapshot(
    root: RemotePath,
    list_documents: Callable[[], Mapping[str, RemotePath]],
    read: Callable[[Sequence[RemotePath]], Sequence[Content | None]],
) -> None:
    """Write a snapshot of all documents that have settled, and take rows that are valid from the earlier snapshot.

    `read` returns the contents of documents, and None for each that no longer exists.

    Raises:
        SinkError: The snapshot cannot be written.
    """
    clock = root / _FOLDER / "clock"
    with translate_errors(root):
        clock.write_bytes(b"")  # its time of change is the time of the server
        settled_ns = clock.stat().st_mtime_ns - _SETTLED_NS
    missing = {key: path for key, path in list_documents().items() if path.stat().st_mtime_ns <= settled_ns}
    target = root / _FOLDER / _FILE
    with (
        translate_errors(root),
        pq.ParquetWriter(
            target.filesystem_path, _SCHEMA, filesystem=target.filesystem, compression="zstd"
        ) as writer,
    ):
        for batch in _batches(root, _SCHEMA.names):
            valid = batch.take(_unchanged(batch, missing))
            writer.write_batch(valid)
            for key in valid.column("key").to_pylist():
                missing.pop(str(key))
        paths = iter(missing.values())
        while group := list(islice(paths, _GROUP_ROWS)):
            writer.write_batch(pa.RecordBatch.from_pylist(list(_rows(group, read(group))), schema=_SCHEMA))


def _rows(paths: Sequence[RemotePath], contents: Iterable[Content | None]) -> Iterator[dict[str, object]]:
    for path, content in zip(paths, contents, strict=True):
        if content is not None:
            stat = path.stat()  # of the listing
            yield {
                "key": path.name,
                "size": stat.st_size,
                "mtime_ns": stat.st_mtime_ns,
                SUMMARY: content.summary,
                DOCUMENT: content.document,
            }


def _batches(root: RemotePath, columns: Sequence[str]) -> Iterator[pa.RecordBatch]:
    """Yield the rows of the snapshot; none if there is no snapshot, or if it is damaged."""
    path = root / _FOLDER / _FILE
    try:
        with (
            translate_errors(root),
            pq.ParquetFile(path.filesystem_path, filesystem=path.filesystem) as parquet,
        ):
            yield from parquet.iter_batches(batch_size=_GROUP_ROWS, columns=list(columns))
    except (IngestError, OSError, pa.ArrowException):
        return


def _unchanged(batch: pa.RecordBatch, documents: Mapping[str, RemotePath]) -> pa.Int64Array:
    """Return the positions of rows whose document is listed with the same size and time of change."""
    states = zip(*(batch.column(name).to_pylist() for name in ("key", "size", "mtime_ns")), strict=True)
    positions: list[int] = []
    for position, (key, size, mtime_ns) in enumerate(states):
        if key in documents:
            stat = documents[key].stat()
            if (stat.st_size, stat.st_mtime_ns) == (size, mtime_ns):
                positions.append(position)
    return pa.array(positions, pa.int64())
