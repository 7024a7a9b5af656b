"""This file is a sequence as a JSON document: all the catalog knows of it, and what each change makes of it."""

from __future__ import annotations

import json
from base64 import b64decode, b64encode
from collections.abc import Iterator
from typing import Any

import pyarrow as pa
from pydantic import BaseModel, ConfigDict

from mosaico_ingest.ontology.types import OntologyType, SerializationFormat
from mosaico_ingest.policies import IfExists
from mosaico_ingest.remote.path import RemotePath
from mosaico_ingest.sink import check_same_type, sequence_exists
from mosaico_ingest.store.entries import Claim, NewNote, NewSession, NewTopic, changed
from mosaico_ingest.store.faults import NotInStore
from mosaico_ingest.store.model import Note, SegmentInfo, SequenceInfo, SessionInfo, TopicInfo
from mosaico_ingest.store.segment import Segment

__all__ = ["FORMAT", "SequenceDocument", "check_unchanged"]

FORMAT = 1
"""Counts up when a document can no longer be read by what was released before."""


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
    """Of each column that has an order: its path, its smallest and its largest value."""


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
    """One session that was committed."""

    id: str
    metadata: dict[str, Any]
    created_ns: int
    completed_ns: int


class NoteEntry(_Part):
    """One error that was attached."""

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
        """What its topics hold."""
        return {topic.name: topic.ontology for topic in self.topics}

    @property
    def paths(self) -> list[str]:
        """The paths of all its segments."""
        return [segment.path for topic in self.topics for segment in topic.segments]

    def info(self, root: RemotePath) -> SequenceInfo:
        """Return it as the catalog's callers know it."""
        return SequenceInfo(
            name=self.name,
            metadata=self.metadata,
            created_ns=self.created_ns,
            sessions=tuple(
                SessionInfo(one.id, one.metadata, one.created_ns, one.completed_ns)
                for one in sorted(self.sessions, key=lambda one: one.id)
            ),
            topics=tuple(
                self._topic(topic, root) for topic in sorted(self.topics, key=lambda topic: topic.name)
            ),
            notes=tuple(Note(one.topic, one.message, one.created_ns) for one in self.notes),
        )

    def with_session(self, new: NewSession, *, completed_ns: int) -> SequenceDocument:
        """Return the sequence with all that a session wrote."""
        entry = SessionEntry(
            id=new.id,
            metadata=json.loads(new.metadata),
            created_ns=new.created_ns,
            completed_ns=completed_ns,
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

    def with_note(self, new: NewNote) -> SequenceDocument:
        """Return the sequence with one more note."""
        return self.model_copy(update={"notes": (*self.notes, _note(new))})

    def without_notes(self, topic: str | None) -> SequenceDocument:
        """Return the sequence without its own notes, or without those of a topic."""
        return self.model_copy(update={"notes": tuple(one for one in self.notes if one.topic != topic)})

    def without_topic(self, name: str) -> SequenceDocument:
        """Return the sequence without a topic; NotInStore where it has none of that name."""
        rest = tuple(topic for topic in self.topics if topic.name != name)
        if len(rest) == len(self.topics):
            raise NotInStore(f"there is no topic {name!r}", where=self.name)
        return self.without_notes(name).model_copy(update={"topics": rest})

    def without_session(self, session: str) -> SequenceDocument:
        """Return the sequence without what a session added; NotInStore where it has none of that name."""
        rest = tuple(one for one in self.sessions if one.id != session)
        if len(rest) == len(self.sessions):
            raise NotInStore(f"there is no session {session!r}", where=self.name)
        topics = (
            topic.model_copy(
                update={"segments": tuple(one for one in topic.segments if one.session != session)}
            )
            for topic in self.topics
        )
        kept = tuple(topic for topic in topics if topic.segments or topic.session != session)
        return self.model_copy(update={"sessions": rest, "topics": kept})

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
    """Refuse a commit because the sequence is there by now, or is not what it was when the session began.

    Raises:
        SequenceExists: It is there, and must not be.
        SinkError: Somebody else changed it.
    """
    if now is not None and claimed.if_exists in {IfExists.FAIL, IfExists.SKIP}:
        raise sequence_exists(claimed.sequence)
    if claimed.sequence_id is not None and (now is None or now.created_ns != claimed.sequence_id):
        raise changed(claimed.sequence)
    if claimed.if_exists is IfExists.REPLACE and now is not None and now.session_ids != claimed.sessions:
        raise changed(claimed.sequence)


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
    )


def _note(new: NewNote) -> NoteEntry:
    return NoteEntry(topic=new.topic, message=new.message, created_ns=new.created_ns)
