"""The content of a catalog, the changes that a session makes, and the interfaces of a store's parts."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, Protocol

import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.destinations import FamilyTopic
from mosaico_ingest.destinations.store.files import NotInStore
from mosaico_ingest.destinations.store.segment import Segment, combined
from mosaico_ingest.display import bytes_text, count_text, counted, seconds_text, time_text
from mosaico_ingest.documents import html_table
from mosaico_ingest.errors import SinkError, missing_library
from mosaico_ingest.findings import suggest_names
from mosaico_ingest.job.values import ATTACHMENTS_KEY, IfExists
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.remote import AnyPath

if TYPE_CHECKING:
    import duckdb
    import pandas as pd
    import polars as pl

    from mosaico_ingest.destinations.store.store import Moment


class MergedSegment(Struct, frozen=True):
    """A segment whose rows are now part of a merged one."""

    session: str
    checksum: str | None


class SegmentInfo(Struct, frozen=True):
    """One Parquet file: rows of one topic and session, sorted by `timestamp_ns`."""

    path: AnyPath
    session: str
    rows: int
    stored_bytes: int
    start_ns: int
    end_ns: int
    """The largest time stamp, inclusive."""
    checksum: str | None
    """Checksum of the row values, see `ContentHash`; None for segments of early versions."""
    merged: tuple[MergedSegment, ...] = ()
    """The segments that compaction merged into this one, in the order of their time stamps."""

    @property
    def parts(self) -> tuple[MergedSegment, ...]:
        """The segments that sessions wrote: those merged, or this one."""
        return self.merged or (MergedSegment(self.session, self.checksum),)


class TopicInfo(Struct, frozen=True):
    """One topic: its type, its columns, and the segments that hold its rows."""

    sequence: str
    name: str
    """With its leading slash."""
    session: str
    """The session that created it."""
    ontology: OntologyType
    schema: pa.Schema
    metadata: Mapping[str, Any]
    created_ns: int
    segments: tuple[SegmentInfo, ...]
    """Sorted by start, then by session."""

    @property
    def rows(self) -> int:
        """Number of rows."""
        return sum(segment.rows for segment in self.segments)

    @property
    def stored_bytes(self) -> int:
        """Size of its files in bytes."""
        return sum(segment.stored_bytes for segment in self.segments)

    @property
    def start_ns(self) -> int | None:
        """The smallest time stamp, or None without rows."""
        return min((segment.start_ns for segment in self.segments), default=None)

    @property
    def end_ns(self) -> int | None:
        """The largest time stamp, inclusive, or None without rows."""
        return max((segment.end_ns for segment in self.segments), default=None)

    @property
    def checksum(self) -> str | None:
        """Checksum of the row values, or None if a segment has none; compaction does not change it."""
        return combined(part.checksum for segment in self.segments for part in segment.parts)

    def __repr__(self) -> str:
        """Return name, ontology, rows and size, such as `<Topic yard/imu: IMU, 1,000 rows, 43.6 kB>`."""
        facts = f"{self.ontology.tag}, {counted(self.rows, 'row')}, {bytes_text(self.stored_bytes)}"
        return f"<Topic {self.sequence}{self.name}: {facts}>"

    def _repr_html_(self) -> str:
        """Return a table of the columns for a notebook."""
        rows = ((field.name, str(field.type), "" if field.nullable else "not null") for field in self.schema)
        notes = [f"{time_text(self.start_ns)} .. {time_text(self.end_ns)} UTC"] if self.rows else []
        return html_table(repr(self)[1:-1], ("column", "type", ""), rows, count=len(self.schema), notes=notes)

    def to_arrow(
        self,
        start: Moment | None = None,
        end: Moment | None = None,
        columns: Sequence[str] | None = None,
        *,
        flatten: bool = False,
    ) -> pa.Table:
        """Return the rows from `start` (inclusive) to `end` (exclusive) as an Arrow table, ordered by time.

        Args:
            start: The start: ns since the epoch, a `datetime` (UTC by default), or a text such as `2026-03-01T12:00:00Z`,
                `+10s` (after the first row) or `-5s` (before the last row).
            end: The end, in the same notations.
            columns: Columns (`pose`) and members of structs (`pose.position.x`); `timestamp_ns` is always the first column.
            flatten: Replace each struct with one column per member, such as `pose.position.x`.

        Raises:
            SinkError: A column does not exist, or a text is not a time.
        """
        from mosaico_ingest.destinations.store.store import read_table  # noqa: PLC0415 - it reads topics

        return read_table(self, start=start, end=end, columns=columns, flatten=flatten)

    def to_reader(
        self,
        start: Moment | None = None,
        end: Moment | None = None,
        columns: Sequence[str] | None = None,
    ) -> pa.RecordBatchReader:
        """Return a reader of the rows, for topics larger than memory; `columns` are names of top-level columns."""
        from mosaico_ingest.destinations.store.store import topic_reader  # noqa: PLC0415 - it reads topics

        return topic_reader(self, start=start, end=end, columns=columns)

    def to_pandas(
        self,
        start: Moment | None = None,
        end: Moment | None = None,
        columns: Sequence[str] | None = None,
        *,
        flatten: bool = False,
    ) -> pd.DataFrame:
        """Return the rows as a pandas frame; the arguments are those of `to_arrow`.

        Raises:
            IngestError: pandas is not installed.
        """
        table = self.to_arrow(start, end, columns, flatten=flatten)
        try:
            return table.to_pandas()
        except ImportError as error:
            raise missing_library("pandas", "frames") from error

    def to_polars(
        self,
        start: Moment | None = None,
        end: Moment | None = None,
        columns: Sequence[str] | None = None,
        *,
        flatten: bool = False,
    ) -> pl.DataFrame:
        """Return the rows as a Polars frame; the arguments are those of `to_arrow`.

        Raises:
            IngestError: Polars is not installed.
        """
        try:
            import polars as pl  # noqa: PLC0415 - an optional library
        except ImportError as error:
            raise missing_library("Polars", "frames") from error
        return pl.DataFrame(self.to_arrow(start, end, columns, flatten=flatten))

    def to_duckdb(
        self,
        start: Moment | None = None,
        end: Moment | None = None,
        columns: Sequence[str] | None = None,
        *,
        flatten: bool = False,
    ) -> duckdb.DuckDBPyRelation:
        """Return the rows as a DuckDB relation; the arguments are those of `to_arrow`.

        Raises:
            IngestError: DuckDB is not installed.
        """
        try:
            import duckdb  # noqa: PLC0415 - an optional library
        except ImportError as error:
            raise missing_library("DuckDB", "sql") from error
        return duckdb.from_arrow(self.to_arrow(start, end, columns, flatten=flatten))


class SessionInfo(Struct, frozen=True):
    """A committed writing session."""

    id: str
    """A ULID: sessions sort by their start."""
    metadata: Mapping[str, Any]
    """The metadata of the session; the sequence keeps the metadata of its first session."""
    created_ns: int
    completed_ns: int


class Note(Struct, frozen=True):
    """An error attached to a sequence, or to one of its topics."""

    topic: str | None
    message: str
    created_ns: int


class AttachmentInfo(Struct, frozen=True):
    """A file of a sequence."""

    path: AnyPath
    session: str
    name: str
    """The name in the recording."""
    media_type: str
    log_ns: int
    create_ns: int
    stored_bytes: int
    checksum: str
    """XXH3 (128 bits) of the content."""


def attachments_of(sessions: Iterable[SessionInfo], root: AnyPath) -> tuple[AttachmentInfo, ...]:
    """Return the attachments that the metadata of sessions lists; entries in another form are ignored."""
    attachments: list[AttachmentInfo] = []
    for session in sessions:
        entries = session.metadata.get(ATTACHMENTS_KEY)
        for entry in entries if isinstance(entries, list) else ():
            with suppress(KeyError, TypeError):
                attachments.append(
                    AttachmentInfo(
                        root / str(entry["path"]),
                        session.id,
                        str(entry["name"]),
                        str(entry["media_type"]),
                        int(entry["log_ns"]),
                        int(entry["create_ns"]),
                        int(entry["bytes"]),
                        str(entry["checksum"]),
                    )
                )
    return tuple(attachments)


class SequenceInfo(Struct, frozen=True):
    """One sequence with its sessions, topics and notes."""

    name: str
    metadata: Mapping[str, Any]
    created_ns: int
    sessions: tuple[SessionInfo, ...]
    topics: tuple[TopicInfo, ...]
    """Sorted by name."""
    notes: tuple[Note, ...]
    attachments: tuple[AttachmentInfo, ...] = ()

    @property
    def incomplete(self) -> str | None:
        """The reason why rows may be missing: the error that ended a run early, or a missing session."""
        return reason_incomplete(self.notes, has_session=bool(self.sessions))

    @property
    def rows(self) -> int:
        """Number of rows of all topics."""
        return sum(topic.rows for topic in self.topics)

    @property
    def stored_bytes(self) -> int:
        """Size of the files of its topics in bytes."""
        return sum(topic.stored_bytes for topic in self.topics)

    @property
    def start_ns(self) -> int | None:
        """The smallest time stamp, or None without rows."""
        return min(_not_none(topic.start_ns for topic in self.topics), default=None)

    @property
    def end_ns(self) -> int | None:
        """The largest time stamp, inclusive, or None without rows."""
        return max(_not_none(topic.end_ns for topic in self.topics), default=None)

    def topic(self, name: str) -> TopicInfo:
        """Return a topic; the leading slash of its name is optional.

        Raises:
            NotInStore: It does not exist; the hint names existing ones.
        """
        topics = {topic.name: topic for topic in self.topics}
        full_name = f"/{name.removeprefix('/')}"
        if full_name not in topics:
            raise NotInStore(
                f"there is no topic {full_name!r}", where=self.name, hint=suggest_names(topics, [full_name])
            )
        return topics[full_name]

    def __repr__(self) -> str:
        """Return name, counts and size, such as `<Sequence yard: 9 topics, 2,110 rows, 493.1 kB>`."""
        facts = f"{counted(len(self.topics), 'topic')}, {counted(self.rows, 'row')}, {bytes_text(self.stored_bytes)}"
        return f"<Sequence {self.name}: {facts}>"

    def _repr_html_(self) -> str:
        """Return a table of the topics for a notebook."""
        rows = (
            (topic.name, topic.ontology.tag, count_text(topic.rows), bytes_text(topic.stored_bytes))
            for topic in self.topics
        )
        span = ""
        if self.start_ns is not None and self.end_ns is not None:
            span = f", {time_text(self.start_ns)} UTC, {seconds_text((self.end_ns - self.start_ns) / 1e9)}"
        names = ("topic", "ontology", "rows", "size")
        caption = f"{repr(self)[1:-1]}{span}"
        notes = [] if self.incomplete is None else [f"incomplete: {self.incomplete}"]
        return html_table(caption, names, rows, count=len(self.topics), numbers={"rows", "size"}, notes=notes)


class Collected(Struct, frozen=True):
    """The result of a garbage collection."""

    sessions: int
    """Number of removed sessions whose writers had died."""
    files: int
    stored_bytes: int


class Claim(Struct, frozen=True):
    """The state of a sequence at the start of a session; the commit fails if it has changed."""

    sequence: str
    if_exists: IfExists
    sequence_id: int | None
    sessions: tuple[str, ...]
    types: Mapping[str, OntologyType]
    """The types of its topics, for a session that appends to them."""


class NewTopic(Struct, frozen=True):
    """A topic of a new session, and its segments by their paths relative to the store."""

    name: str
    ontology: OntologyType
    schema: pa.Schema
    metadata: str
    created_ns: int
    segments: Mapping[str, Segment]


class NewNote(Struct, frozen=True):
    """A new error to attach."""

    topic: str | None
    message: str
    created_ns: int


def check_not_merged(session: str, sequence: str, segments: Iterable[tuple[MergedSegment, ...]]) -> None:
    """Check that no merged segment contains rows of this session and of other sessions.

    Raises:
        SinkError: A segment does, so the session cannot be removed.
    """
    for merged in segments:
        sessions = {part.session for part in merged}
        if session in sessions and len(sessions) > 1:
            raise SinkError(
                f"compaction merged the rows of session {session} with rows of other sessions",
                where=sequence,
                hint="replace or remove the sequence",
            )


class Replacement(Struct, frozen=True):
    """A merged segment and the segments of its topic that it replaces."""

    sequence: str
    topic: str
    replaced: tuple[str, ...]
    """Their paths, relative to the store."""
    path: str
    session: str
    """The session of the first of them."""
    segment: Segment
    merged: tuple[MergedSegment, ...]


class NewSession(Struct, frozen=True):
    """Everything a new session wrote."""

    id: str
    metadata: str
    created_ns: int
    topics: tuple[NewTopic, ...]
    notes: tuple[NewNote, ...]


def reason_incomplete(notes: Iterable[Note], *, has_session: bool) -> str | None:
    """Return the latest error of the sequence itself, or that it has no session; None for a complete sequence."""
    errors = [note.message for note in notes if note.topic is None]
    if errors:
        return errors[-1]
    return None if has_session else "no session was finished"


def _not_none(times: Iterable[int | None]) -> list[int]:
    return [time for time in times if time is not None]


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


def _text_at(metadata: Mapping[str, Any], key: str) -> str | None:
    """Return the value at a dotted key as text, or None if the metadata has no such key."""
    value: Any = metadata
    for part in key.split("."):
        if not isinstance(value, Mapping) or part not in value:
            return None
        value = value[part]
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"), ensure_ascii=False)


class Lease(Protocol):
    """Shows other processes that a writer is alive."""

    def release(self) -> None:
        """Release the lease; a second call has no effect."""
        ...


class Closable(Protocol):
    """An object that can be closed."""

    def close(self) -> None:
        """Close it."""
        ...


class Files(Protocol):
    """The files of a store: `LocalFiles` on a disk, `ObjectFiles` behind a URL."""

    @property
    def root(self) -> AnyPath:
        """The folder of the store."""
        ...

    def topic(self, sequence: str, topic: str) -> AnyPath:
        """Return the folder of a topic's segments."""
        ...

    def staged(self, session: str, sequence: str, topic: str, number: int) -> AnyPath:
        """Return the path at which a session writes a segment before the commit."""
        ...

    def attachment(self, sequence: str, name: str) -> AnyPath:
        """Return the path of an attachment after the commit."""
        ...

    def staged_attachment(self, session: str, sequence: str, name: str) -> AnyPath:
        """Return the path at which a session writes an attachment before the commit."""
        ...

    def relative(self, path: AnyPath) -> str:
        """Return a segment's path relative to the store, as in the catalog."""
        ...

    def begin(self, session: str) -> Lease:
        """Prepare a session and return the lease that shows that its writer is alive."""
        ...

    def is_live(self, session: str) -> bool:
        """Return whether the session's writer is alive."""
        ...

    def in_use(self, session: str, grace_s: float) -> bool:
        """Return whether the session's writer is alive or may be about to start."""
        ...

    def sync(self, paths: Sequence[AnyPath]) -> None:
        """Wait until closed files are on the disk."""
        ...

    def publish(self, moves: Mapping[AnyPath, AnyPath]) -> None:
        """Move synced files to their final paths, so that they survive a power cut; files that were moved are skipped."""
        ...

    def remove(self, paths: Iterable[AnyPath]) -> None:
        """Remove segments; garbage collection retries failed removals."""
        ...

    def discard(self, session: str) -> None:
        """Remove the staged files of a session."""
        ...

    def open_sessions(self) -> list[str]:
        """Return the sessions that were started and not ended, alive or not."""
        ...

    def staged_files(self, session: str) -> list[AnyPath]:
        """Return the segments that a session started and did not publish."""
        ...

    def segment_files(self) -> Iterator[AnyPath]:
        """Yield every file below the folder of segments."""
        ...


class StoreCatalog(Protocol):
    """The catalog of a store: `Catalog` in SQLite, `ObjectCatalog` as JSON documents behind a URL.

    Every change is atomic. Methods that remove entries return the paths of segments that are no longer needed.
    """

    def keep_open(self) -> Closable:
        """Return a handle that keeps the catalog open, which makes calls cheaper until it is closed."""
        ...

    def claim(
        self, session: str, sequence: str, if_exists: IfExists, *, is_live: Callable[[str], bool]
    ) -> Claim:
        """Claim a sequence for a session.

        Raises:
            SequenceExists: The sequence exists and `if_exists` forbids it, or another session writes it.
        """
        ...

    def commit(self, sessions: Sequence[tuple[Claim, NewSession]]) -> list[str]:
        """Add sessions and return the paths of the segments they replace.

        A catalog with transactions adds all of them, or none if one cannot be added. Others commit one session at a time.
        """
        ...

    def replace_segments(self, change: Replacement) -> bool:
        """Enter a merged segment in place of others; False if one of them is not in the catalog any more."""
        ...

    def release(self, session: str, sequence: str) -> None:
        """Release the claim of a session."""
        ...

    def create(self, sequence: str, metadata: str) -> None:
        """Add a sequence without a session."""
        ...

    def note(self, sequence: str, new: NewNote) -> None:
        """Attach a note to an existing sequence."""
        ...

    def names(self) -> list[str]:
        """Return the sorted names of all sequences."""
        ...

    def sequence(self, name: str) -> SequenceInfo | None:
        """Return a sequence, or None."""
        ...

    def headers(self, names: Collection[str]) -> tuple[SequenceInfo, ...]:
        """Return the sequences with these names, without their topics, in any order."""
        ...

    def sequences(self) -> tuple[SequenceInfo, ...]:
        """Return every sequence by name, in one consistent state if the catalog supports it."""
        ...

    def listing(self, selection: SequenceFilter, *, after: str | None, limit: int | None) -> Listing:
        """Return the selected sequences after the name `after`, at most `limit`, sorted by name."""
        ...

    def family_topics(self, family: str | None, names: Collection[str]) -> tuple[FamilyTopic, ...]:
        """Return the topics with these names that sessions of the family created, oldest session first."""
        ...

    def bounds(self, topic: TopicInfo, columns: Collection[str]) -> dict[AnyPath, dict[str, tuple[Any, Any]]]:
        """Return the bounds of columns by segment path."""
        ...

    def delete_sequence(self, sequence: str) -> list[str]:
        """Remove a sequence; raises NotInStore if it does not exist."""
        ...

    def delete_topic(self, sequence: str, topic: str) -> list[str]:
        """Remove a topic; raises NotInStore if it does not exist."""
        ...

    def delete_session(self, sequence: str, session: str) -> list[str]:
        """Remove everything a session added; raises NotInStore if it does not exist."""
        ...

    def delete_notes(self, sequence: str, topic: str | None) -> None:
        """Remove the notes of a sequence itself, or of one of its topics."""
        ...

    def forget(self, live: Collection[str]) -> set[str]:
        """Remove the claims of sessions that are not alive and return the paths of all segments."""
        ...
