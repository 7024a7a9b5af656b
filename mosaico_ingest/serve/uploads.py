"""This file is the sessions that are open: their topics, how far each upload is, and how they end."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from uuid import uuid4

import pyarrow as pa

from mosaico_ingest import protocol
from mosaico_ingest.destinations.base import ENVELOPE
from mosaico_ingest.destinations.store.errors import NotInStore
from mosaico_ingest.destinations.store.session import StoreSession, StoreTopic
from mosaico_ingest.destinations.store.store import Store
from mosaico_ingest.errors import SinkError
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.protocol import messages
from mosaico_ingest.protocol.batches import validated
from mosaico_ingest.protocol.errors import Condition
from mosaico_ingest.serve.errors import Refusal, checked

__all__ = ["OpenSession", "Uploads"]

_BUFFER_BYTES = 96 << 20


class _State(Enum):
    CREATED = "was never uploaded"
    UPLOADING = "is still being uploaded"
    BROKEN = "broke off in the middle of its upload"
    DONE = "is uploaded"


@dataclass(slots=True)
class _Topic:
    name: str
    question: messages.TopicCreate
    state: _State = _State.CREATED


@dataclass(slots=True)
class OpenSession:
    """A session that takes topics."""

    uuid: str
    sequence: str
    session: StoreSession
    topics: dict[str, _Topic] = field(default_factory=dict[str, _Topic])
    """By the UUID each upload names."""
    heard_s: float = field(default_factory=time.monotonic)
    """When its client last said something, on the monotonic clock."""

    @property
    def locator(self) -> str:
        """As `drive:01J…`."""
        return messages.session_locator(self.sequence, self.session.id)


class Uploads:
    """All sessions of a server that are not in its store yet."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._sessions: dict[str, OpenSession] = {}
        self._committing: dict[str, OpenSession] = {}
        """They take nothing more, and their topics are not in the store yet."""
        self._finalized: set[str] = set()
        self._lock = threading.RLock()

    def of_sequence(self, sequence: str) -> tuple[OpenSession, ...]:
        """Return the sessions of a sequence that are open or being committed."""
        with self._lock:
            waiting = (*self._sessions.values(), *self._committing.values())
            return tuple(each for each in waiting if each.sequence == sequence)

    def open(self, sequence: str) -> OpenSession:
        """Open a session of a sequence that is there."""
        self._store.sequence(sequence)
        session = StoreSession(
            self._store.layout,
            self._store.catalog,
            sequence,
            "{}",
            if_exists=IfExists.APPEND,
            buffer_bytes=_BUFFER_BYTES,
        )
        opened = OpenSession(str(uuid4()), sequence, session)
        with self._lock:
            self._sessions[opened.uuid] = opened
        return opened

    def add_topic(self, question: messages.TopicCreate) -> str:
        """Announce a topic and return the UUID its upload must name."""
        sequence, _, path = question.locator.partition("/")
        with checked():
            name = protocol.check_topic_name(path)
            protocol.check_metadata(question.user_metadata, where=question.locator)
        with self._lock:
            held = {topic.name for topic in self._store.sequence(sequence).topics}
            opened = self._session(question.session_uuid)
            if opened.sequence != sequence:
                raise Refusal(
                    Condition.PERMISSION, f"the session writes {opened.sequence!r}, not {sequence!r}"
                )
            if name in held | self._announced(sequence):
                raise Refusal(Condition.EXISTS, f"topic {question.locator!r} already exists")
            uuid = str(uuid4())
            opened.topics[uuid] = _Topic(name, question)
            return uuid

    def receive(self, put: messages.Put, schema: pa.Schema, batches: Iterable[pa.RecordBatch]) -> None:
        """Take the one upload of a topic."""
        ontology_columns = _payload(schema)
        with self._lock:
            opened, topic, writer = self._begin(put, ontology_columns)
        try:
            for batch in batches:
                self._hear(opened)
                with checked():
                    rows = _rows(batch, writer.schema)
                writer.write(rows)
            writer.close()
        except BaseException:
            topic.state = _State.BROKEN
            raise
        topic.state = _State.DONE

    def finalize(self, uuid: str) -> None:
        """Make a session visible."""
        with self._lock:
            opened = self._session(uuid)
            if not opened.topics:
                raise Refusal(Condition.PRECONDITION, "the session is empty")
            for topic in opened.topics.values():
                if topic.state is not _State.DONE:
                    text = f"topic {topic.question.locator!r} {topic.state.value}"
                    raise Refusal(Condition.PRECONDITION, text)
            self._committing[uuid] = self._sessions.pop(uuid)
        try:
            opened.session.commit()
            self._finalized.add(uuid)
        except BaseException:
            opened.session.discard()
            raise
        finally:
            with self._lock:
                del self._committing[uuid]

    def discard_session(self, locator: str) -> bool:
        """Drop the open session at `locator`; return whether there is one."""
        with self._lock:
            found = [each for each in self._sessions.values() if each.locator == locator]
            return self._drop(found)

    def discard_sequence(self, sequence: str) -> bool:
        """Drop the open sessions of a sequence; return whether there are any."""
        with self._lock:
            return self._drop(self._open(sequence))

    def discard_topic(self, sequence: str, name: str) -> bool:
        """Forget a topic that was announced and never uploaded; return whether there is one."""
        with self._lock:
            for opened in self._open(sequence):
                for uuid, topic in tuple(opened.topics.items()):
                    if topic.name == name:
                        if topic.state is not _State.CREATED:
                            raise Refusal(Condition.PRECONDITION, f"topic {name!r} {topic.state.value}")
                        del opened.topics[uuid]
                        return True
        return False

    def has_topic(self, sequence: str, name: str) -> bool:
        """Return whether a session has announced the topic."""
        with self._lock:
            return name in self._announced(sequence)

    def discard_idle(self, idle_s: float) -> bool:
        """Drop the open sessions whose clients have said nothing for so long; return whether there are any."""
        before = time.monotonic() - idle_s
        with self._lock:
            return self._drop([each for each in self._sessions.values() if each.heard_s < before])

    def close(self) -> None:
        """Drop every open session."""
        with self._lock:
            self._drop(tuple(self._sessions.values()))

    def _begin(self, put: messages.Put, payload: pa.StructType) -> tuple[OpenSession, _Topic, StoreTopic]:
        owners = [each for each in self._sessions.values() if put.topic_uuid in each.topics]
        if not owners:
            raise NotInStore(f"there is no topic with the UUID {put.topic_uuid}")
        topic = owners[0].topics[put.topic_uuid]
        if topic.question.locator != put.resource_locator:
            raise Refusal(Condition.PERMISSION, f"the UUID is that of {topic.question.locator!r}")
        if topic.state is not _State.CREATED:
            raise Refusal(Condition.PRECONDITION, f"topic {put.resource_locator!r} {topic.state.value}")
        ontology = OntologyType(topic.question.ontology_tag, payload, topic.question.serialization_format)
        with checked():
            writer = owners[0].session.topic(topic.name, ontology, topic.question.user_metadata)
        topic.state = _State.UPLOADING
        return owners[0], topic, writer

    def _open(self, sequence: str) -> tuple[OpenSession, ...]:
        return tuple(each for each in self._sessions.values() if each.sequence == sequence)

    def _announced(self, sequence: str) -> set[str]:
        return {topic.name for each in self.of_sequence(sequence) for topic in each.topics.values()}

    def _hear(self, opened: OpenSession) -> None:
        opened.heard_s = time.monotonic()
        if opened.uuid not in self._sessions:
            raise Refusal(Condition.PRECONDITION, "the session has ended")

    def _session(self, uuid: str) -> OpenSession:
        if uuid in self._committing or uuid in self._finalized:
            raise Refusal(Condition.PRECONDITION, "the session is finalized already")
        if uuid not in self._sessions:
            raise NotInStore(f"there is no open session {uuid}")
        self._sessions[uuid].heard_s = time.monotonic()
        return self._sessions[uuid]

    def _drop(self, sessions: Iterable[OpenSession]) -> bool:
        dropped = False
        for opened in sessions:
            del self._sessions[opened.uuid]
            opened.session.discard()
            dropped = True
        return dropped


def _rows(batch: pa.RecordBatch, schema: pa.Schema) -> pa.RecordBatch:
    """Return a client's batch in the order of a topic's columns.

    Raises:
        pa.ArrowInvalid: The batch is malformed.
        SinkError: A row has no time stamp.
    """
    complete = validated(batch)
    columns = [complete.column(name) for name in schema.names]
    if complete.column(ENVELOPE.name).null_count:
        raise SinkError(f"a row has no {ENVELOPE.name}")
    return pa.RecordBatch.from_arrays(columns, schema=schema)


def _payload(schema: pa.Schema) -> pa.StructType:
    """Return the columns beside the envelope's, which must be there."""
    with checked():
        if schema.get_field_index(ENVELOPE.name) < 0 or schema.field(ENVELOPE.name).type != ENVELOPE.type:
            raise pa.ArrowInvalid("the schema has no column timestamp_ns of int64")
    return pa.struct([column for column in schema if column.name != ENVELOPE.name])
