"""The documents of a catalog behind a URL, and their snapshots."""

from __future__ import annotations

import json
from base64 import b64decode, b64encode
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from itertools import islice
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from msgspec import Struct
from pydantic import BaseModel, ConfigDict

from mosaico_ingest.destinations import check_same_type, sequence_exists
from mosaico_ingest.destinations.store.files import (
    CHANGES,
    NotInStore,
    new_session_id,
    opened,
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
from mosaico_ingest.errors import SinkError, SinkUnavailable
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
"""The columns with the content of a sequence; each has its own file."""
_FOLDER, _INDEX = "snapshots", "index.parquet"
_SETTLED_NS = 5 * 10**9
"""Time since the last change after which a document is recognized by its time of change; object stores list times in full
seconds, so a later change of the same second would not be visible."""
_GROUP_ROWS = 1000
_CONTENT = {name: pa.schema([pa.field(name, pa.binary())]) for name in (SUMMARY, DOCUMENT)}


class Row(Struct, frozen=True):
    """A sequence in the index of a snapshot."""

    key: str
    """The name of its document, without the suffix."""
    name: str
    size: int
    mtime_ns: int
    """Size and time of change of the document that the row was built from; -1 if a later change may not be visible."""

    def is_current(self, document: RemotePath) -> bool:
        """Return whether a listed document has not changed since."""
        stat = document.stat()
        return (stat.st_size, stat.st_mtime_ns) == (self.size, self.mtime_ns)


_INDEX_SCHEMA = pa.schema(
    [
        pa.field("key", pa.string()),
        pa.field("name", pa.string()),
        pa.field("size", pa.int64()),
        pa.field("mtime_ns", pa.int64()),
    ]
)


class DamagedSnapshot(SinkError):  # noqa: N818 - the condition, as in `errors`
    """A file of a snapshot is missing or damaged."""


class Content(Struct, frozen=True):
    """The content of a sequence, as JSON."""

    name: str
    summary: bytes
    document: bytes


class Snapshot(Struct, frozen=True):
    """The sequences of a catalog in three Parquet files: an index, the summaries and the documents, in the order of keys."""

    folder: RemotePath
    rows: tuple[Row, ...]

    def read(self, column: str, positions: Collection[int]) -> Iterator[tuple[int, bytes]]:
        """Yield the content of the rows at these positions, in their order; all of their row groups are read.

        Raises:
            DamagedSnapshot: The file is missing or damaged.
        """
        groups = sorted({position // _GROUP_ROWS for position in positions})
        selected = set(positions)
        for group, batch in zip(groups, _batches(self.folder, column, groups), strict=False):
            start = group * _GROUP_ROWS
            for offset, value in enumerate(batch.column(column)):
                if start + offset in selected:
                    yield start + offset, value.as_py()


class Snapshots(Struct, frozen=True):
    """The published snapshots of a catalog."""

    number: int
    """The highest number, 0 without snapshots."""
    folders: tuple[RemotePath, ...]
    """Its folders: several if writers published the same number, so that none of them may contain all changes."""
    obsolete: tuple[RemotePath, ...]
    """The files of earlier snapshots, which readers may no longer have open once the next one is published."""

    @classmethod
    def listed(cls, root: RemotePath) -> Snapshots:
        """List the snapshots of a store."""
        with translate_errors(root):
            files = [path for path in (root / _FOLDER).listing(recursive=True) if path.is_file()]
        published = [path.parent for path in files if path.name == _INDEX]
        number = max(map(_number, published), default=0)
        return cls(
            number,
            tuple(folder for folder in published if _number(folder) == number),
            tuple(path for path in files if _number(path.parent) < number),
        )

    def latest(self) -> Snapshot | None:
        """Return the latest snapshot; None if there is none, if it is damaged, or if its number is ambiguous."""
        if len(self.folders) != 1:
            return None
        (folder,) = self.folders
        try:
            with translate_errors(folder), opened(folder / _INDEX) as parquet:
                columns = parquet.read().to_pydict()
        except SinkUnavailable:
            raise
        except SinkError:
            return None
        return Snapshot(folder, tuple(map(Row, *(columns[name] for name in _INDEX_SCHEMA.names))))


def _number(folder: RemotePath) -> int:
    number = folder.name.partition("-")[0]
    return int(number) if number.isdecimal() else 0


def write_snapshot(
    root: RemotePath,
    now_ns: Callable[[], int],
    list_documents: Callable[[], Mapping[str, RemotePath]],
    read: Callable[[Sequence[RemotePath]], Sequence[Content | None]],
) -> tuple[RemotePath, ...]:
    """Write the next snapshot, and return the objects that are obsolete now: changes, and files of earlier snapshots.

    `now_ns` returns the time of the server, `list_documents` the documents by key, and `read` the contents of documents, None for each that no longer exists.
    Contents that have not changed are copied from the latest snapshot.

    Raises:
        SinkError: The snapshot cannot be written.
    """
    # The order of these steps is essential; see `ObjectCatalog`.
    changes = list_changes(root)
    snapshots = Snapshots.listed(root)
    with translate_errors(root):
        settled_ns = now_ns() - _SETTLED_NS
    documents = dict(sorted(list_documents().items()))
    folder = root / _FOLDER / f"{snapshots.number + 1:09}-{new_session_id()}"
    with ExitStack() as stack:
        stack.enter_context(translate_errors(root))
        writers = {name: stack.enter_context(_writer(folder, name)) for name in _CONTENT}
        rows: list[Row] = []
        pending: list[tuple[Row, Content]] = []
        for row, content in _contents(documents, snapshots.latest(), read):
            rows.append(row if row.mtime_ns <= settled_ns else Row(row.key, row.name, -1, -1))
            pending.append((row, content))
            if len(pending) == _GROUP_ROWS:
                _write(writers, pending)
        _write(writers, pending)
    columns = {name: [getattr(row, name) for row in rows] for name in _INDEX_SCHEMA.names}
    index = pa.BufferOutputStream()
    pq.write_table(pa.table(columns, _INDEX_SCHEMA), index, compression="zstd")
    with translate_errors(root):
        (folder / _INDEX).write_bytes(index.getvalue().to_pybytes())
    return (*changes, *snapshots.obsolete)


def list_changes(root: RemotePath) -> list[RemotePath]:
    """Return the objects that name a sequence that was changed, see `changed_key`."""
    with translate_errors(root):
        return [path for path in (root / CHANGES).iterdir() if path.is_file()]


def changed_key(change: RemotePath) -> str:
    """Return the key of the sequence that a change names."""
    return change.name.partition("-")[2]


def _writer(folder: RemotePath, name: str) -> pq.ParquetWriter:
    path = folder / f"{name}.parquet"
    return pq.ParquetWriter(
        path.filesystem_path, _CONTENT[name], filesystem=path.filesystem, compression="zstd"
    )


def _write(writers: Mapping[str, pq.ParquetWriter], pending: list[tuple[Row, Content]]) -> None:
    """Write the rows as a row group of each file, and clear them."""
    for name, writer in writers.items():
        values = pa.array([getattr(content, name) for _, content in pending], pa.binary())
        if pending:
            writer.write_batch(pa.record_batch([values], schema=_CONTENT[name]))
    pending.clear()


def _contents(
    documents: Mapping[str, RemotePath],
    previous: Snapshot | None,
    read: Callable[[Sequence[RemotePath]], Sequence[Content | None]],
) -> Iterator[tuple[Row, Content]]:
    """Yield the contents of documents in the order of their keys, from the previous snapshot if they have not changed."""
    copies = _copies(previous)
    copy = next(copies, None)
    keys = iter(documents)
    while group := list(islice(keys, _GROUP_ROWS)):
        contents: dict[str, Content | None] = {}
        for key in group:
            while copy is not None and copy[0].key < key:
                copy = next(copies, None)
            if copy is not None and copy[0].key == key and copy[0].is_current(documents[key]):
                contents[key] = copy[1]
        missing = [key for key in group if key not in contents]
        contents.update(zip(missing, read([documents[key] for key in missing]), strict=True))
        for key in group:
            if (content := contents[key]) is not None:
                stat = documents[key].stat()  # of the listing
                yield Row(key, content.name, stat.st_size, stat.st_mtime_ns), content


def _copies(snapshot: Snapshot | None) -> Iterator[tuple[Row, Content]]:
    """Yield the rows of a snapshot up to a damaged one."""
    if snapshot is None:
        return
    positions = range(len(snapshot.rows))
    with suppress(DamagedSnapshot):
        summaries, documents = (snapshot.read(name, positions) for name in (SUMMARY, DOCUMENT))
        for row, (_, summary), (_, document) in zip(snapshot.rows, summaries, documents, strict=False):
            yield row, Content(row.name, summary, document)


def _batches(folder: RemotePath, column: str, groups: Sequence[int]) -> Iterator[pa.RecordBatch]:
    """Yield row groups of a file, one batch each."""
    path = folder / f"{column}.parquet"
    try:
        with translate_errors(path), opened(path) as parquet:
            yield from parquet.iter_batches(_GROUP_ROWS, row_groups=list(groups), columns=[column])
    except SinkUnavailable:
        raise
    except (SinkError, IndexError) as err:
        raise DamagedSnapshot("the snapshot of the catalog is damaged", where=str(path)) from err
