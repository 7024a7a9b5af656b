"""The content of a catalog: sequences, sessions, topics and segments, and the changes that a session makes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.destinations.store.checksum import combined
from mosaico_ingest.destinations.store.segment import Segment
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.remote import AnyPath


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
        """Checksum of the row values, or None if a segment has none."""
        return combined(segment.checksum for segment in self.segments)


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


class SequenceInfo(Struct, frozen=True):
    """One sequence with its sessions, topics and notes."""

    name: str
    metadata: Mapping[str, Any]
    created_ns: int
    sessions: tuple[SessionInfo, ...]
    topics: tuple[TopicInfo, ...]
    """Sorted by name."""
    notes: tuple[Note, ...]

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
        """Size of its files in bytes."""
        return sum(topic.stored_bytes for topic in self.topics)

    @property
    def start_ns(self) -> int | None:
        """The smallest time stamp, or None without rows."""
        return min(_not_none(topic.start_ns for topic in self.topics), default=None)

    @property
    def end_ns(self) -> int | None:
        """The largest time stamp, inclusive, or None without rows."""
        return max(_not_none(topic.end_ns for topic in self.topics), default=None)


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
