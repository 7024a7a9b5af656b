"""This file is what the catalog says of sequences, sessions, topics and segments."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.destinations.store.checksum import combined
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.remote import AnyPath

__all__ = ["Collected", "Note", "SegmentInfo", "SequenceInfo", "SessionInfo", "TopicInfo"]


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
    """Of the values of its rows, see `ContentHash`; None where it was written before there were any."""


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
    """By start, then by session."""

    @property
    def rows(self) -> int:
        """The number of rows."""
        return sum(segment.rows for segment in self.segments)

    @property
    def stored_bytes(self) -> int:
        """The size of its files."""
        return sum(segment.stored_bytes for segment in self.segments)

    @property
    def start_ns(self) -> int | None:
        """The smallest time stamp; None without rows."""
        return min((segment.start_ns for segment in self.segments), default=None)

    @property
    def end_ns(self) -> int | None:
        """The largest time stamp, inclusive; None without rows."""
        return max((segment.end_ns for segment in self.segments), default=None)

    @property
    def checksum(self) -> str | None:
        """Of the values of its rows; None where it is not known of all of them."""
        return combined(segment.checksum for segment in self.segments)


class SessionInfo(Struct, frozen=True):
    """One writing session that was committed."""

    id: str
    """A ULID: sessions sort by their start."""
    metadata: Mapping[str, Any]
    """What the session was opened with; the sequence keeps that of its first session."""
    created_ns: int
    completed_ns: int


class Note(Struct, frozen=True):
    """An error somebody attached to a sequence, or to one of its topics."""

    topic: str | None
    message: str
    created_ns: int


class SequenceInfo(Struct, frozen=True):
    """One sequence with everything the catalog knows of it."""

    name: str
    metadata: Mapping[str, Any]
    created_ns: int
    sessions: tuple[SessionInfo, ...]
    topics: tuple[TopicInfo, ...]
    """By name."""
    notes: tuple[Note, ...]

    @property
    def incomplete(self) -> str | None:
        """The reason why rows may be missing: the error that ended a run early, or a missing session."""
        errors = [note.message for note in self.notes if note.topic is None]
        if errors:
            return errors[-1]
        return None if self.sessions else "no session was finished"

    @property
    def rows(self) -> int:
        """The number of rows of all topics."""
        return sum(topic.rows for topic in self.topics)

    @property
    def stored_bytes(self) -> int:
        """The size of its files."""
        return sum(topic.stored_bytes for topic in self.topics)

    @property
    def start_ns(self) -> int | None:
        """The smallest time stamp; None without rows."""
        return min(_known(topic.start_ns for topic in self.topics), default=None)

    @property
    def end_ns(self) -> int | None:
        """The largest time stamp, inclusive; None without rows."""
        return max(_known(topic.end_ns for topic in self.topics), default=None)


class Collected(Struct, frozen=True):
    """What garbage collection removed."""

    sessions: int
    """Sessions of writers that are no more."""
    files: int
    stored_bytes: int


def _known(times: Iterable[int | None]) -> list[int]:
    return [time for time in times if time is not None]
