"""The open sessions of a server, with their topics and the state of each upload."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from uuid import uuid4

import pyarrow as pa

from mosaico_ingest import protocol
from mosaico_ingest.destinations.base import ENVELOPE, validated
from mosaico_ingest.destinations.store.files import NotInStore
from mosaico_ingest.destinations.store.session import StoreSession, StoreTopic
from mosaico_ingest.destinations.store.store import Store
from mosaico_ingest.errors import SinkError
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.protocol import messages
from mosaico_ingest.protocol.errors import Condition
from mosaico_ingest.serve.errors import Refusal, refuse_invalid

_BUFFER_BYTES = 96 << 20
"""Maximum size of the buffered rows per session, in bytes."""
_MAX_SESSIONS = 128
"""Maximum number of open sessions, each of which keeps file descriptors."""
_ABANDONED_S = 60.0
"""Idle time in seconds after which a session may be discarded for a new one if the limit is reached."""


class _State(Enum):
    CREATED = "was never uploaded"
    UPLOADING = "is still being uploaded"
    BROKEN = "has an interrupted upload"
    DONE = "is uploaded"


@dataclass(slots=True)
class OpenTopic:
    """A topic of an open session, and the state of its upload."""

    name: str
    question: messages.TopicCreate
    state: _State = _State.CREATED


@dataclass(slots=True)
class OpenSession:
    """A session that accepts topics."""

    uuid: str
    sequence: str
    session: StoreSession
    topics: dict[str, OpenTopic] = field(default_factory=dict[str, OpenTopic])
    """The topics by the UUID that their uploads name."""
    last_call_s: float = field(default_factory=time.monotonic)
    """The monotonic time of the client's last call, in seconds."""

    @property
    def locator(self) -> str:
        """The locator of the session, such as `drive:01J…`."""
        return messages.session_locator(self.sequence, self.session.id)

    @property
    def topic_names(self) -> tuple[str, ...]:
        """The sorted names of the topics."""
        return tuple(sorted(topic.name for topic in self.topics.values()))

    def topic_locator(self, name: str) -> str:
        """Return the locator of a topic of the session, such as `drive/imu`."""
        return messages.topic_locator(self.sequence, name)


class Uploads:
    """The sessions of a server that are not committed."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._sessions: dict[str, OpenSession] = {}
        self._committing: dict[str, OpenSession] = {}
        """Sessions that accept no more topics and are not in the store yet, by UUID."""
        self._finalized: set[str] = set()
        self._lock = threading.RLock()

    def of_sequence(self, sequence: str) -> tuple[OpenSession, ...]:
        """Return the sessions of a sequence that are open or being committed."""
        with self._lock:
            sessions = (*self._sessions.values(), *self._committing.values())
            return tuple(each for each in sessions if each.sequence == sequence)

    def open(self, sequence: str) -> OpenSession:
        """Open a session of an existing sequence."""
        self._store.sequence(sequence)
        self._limit_sessions()
        session = StoreSession(
            self._store.layout,
            self._store.catalog,
            sequence,
            "{}",
            if_exists=IfExists.APPEND,
            buffer_bytes=_BUFFER_BYTES,
            keep_catalog_open=False,
        )
        opened = OpenSession(str(uuid4()), sequence, session)
        with self._lock:
            self._sessions[opened.uuid] = opened
        return opened

    def _limit_sessions(self) -> None:
        """If the limit is reached, discard the session with the longest idle time, or refuse the call if none is idle."""
        with self._lock:
            if len(self._sessions) < _MAX_SESSIONS:
                return
            oldest = min(self._sessions.values(), key=lambda each: each.last_call_s)
            if time.monotonic() - oldest.last_call_s < _ABANDONED_S:
                text = f"{_MAX_SESSIONS} sessions are open; finalize or delete one, or try again later"
                raise Refusal(Condition.UNAVAILABLE, text)
            self._discard([oldest])

    def add_topic(self, question: messages.TopicCreate) -> str:
        """Register a topic and return the UUID that its upload must name."""
        sequence, _, path = question.locator.partition("/")
        with refuse_invalid():
            name = protocol.check_topic_name(path)
            protocol.check_metadata(question.user_metadata, where=question.locator)
        with self._lock:
            stored_names = {topic.name for topic in self._store.sequence(sequence).topics}
            opened = self._session(question.session_uuid)
            if opened.sequence != sequence:
                raise Refusal(
                    Condition.PERMISSION, f"the session belongs to {opened.sequence!r}, not to {sequence!r}"
                )
            if name in stored_names | self._topic_names(sequence):
                raise Refusal(Condition.EXISTS, f"topic {question.locator!r} already exists")
            uuid = str(uuid4())
            opened.topics[uuid] = OpenTopic(name, question)
            return uuid

    def receive(self, put: messages.Put, schema: pa.Schema, batches: Iterable[pa.RecordBatch]) -> None:
        """Write the upload of a topic; each topic has one."""
        ontology_columns = _payload_columns(schema)
        with self._lock:
            opened, topic, writer = self._start(put, ontology_columns)
        try:
            for batch in batches:
                self._record_call(opened)
                with refuse_invalid():
                    rows = _rows(batch, writer.schema)
                writer.write(rows)
            writer.close()
        except BaseException:
            topic.state = _State.BROKEN
            raise
        topic.state = _State.DONE

    def finalize(self, uuid: str) -> None:
        """Commit a session, which makes its topics visible."""
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
        """Discard the open session with this locator; return whether it exists."""
        with self._lock:
            sessions = [each for each in self._sessions.values() if each.locator == locator]
            return self._discard(sessions)

    def discard_sequence(self, sequence: str) -> bool:
        """Discard the open sessions of a sequence; return whether there were any."""
        with self._lock:
            return self._discard(self._open_sessions(sequence))

    def discard_topic(self, sequence: str, name: str) -> bool:
        """Remove a topic that was never uploaded; return whether it exists."""
        with self._lock:
            for opened in self._open_sessions(sequence):
                for uuid, topic in tuple(opened.topics.items()):
                    if topic.name == name:
                        if topic.state is not _State.CREATED:
                            raise Refusal(Condition.PRECONDITION, f"topic {name!r} {topic.state.value}")
                        del opened.topics[uuid]
                        return True
        return False

    def has_topic(self, sequence: str, name: str) -> bool:
        """Return whether an open session has the topic."""
        with self._lock:
            return name in self._topic_names(sequence)

    def discard_idle(self, idle_s: float) -> bool:
        """Discard the open sessions that are idle for `idle_s`; return whether there were any."""
        limit_s = time.monotonic() - idle_s
        with self._lock:
            return self._discard([each for each in self._sessions.values() if each.last_call_s < limit_s])

    def close(self) -> None:
        """Discard every open session."""
        with self._lock:
            self._discard(tuple(self._sessions.values()))

    def _start(self, put: messages.Put, payload: pa.StructType) -> tuple[OpenSession, OpenTopic, StoreTopic]:
        owners = [each for each in self._sessions.values() if put.topic_uuid in each.topics]
        if not owners:
            raise NotInStore(f"there is no topic with the UUID {put.topic_uuid}")
        topic = owners[0].topics[put.topic_uuid]
        if topic.question.locator != put.resource_locator:
            raise Refusal(Condition.PERMISSION, f"the UUID belongs to topic {topic.question.locator!r}")
        if topic.state is not _State.CREATED:
            raise Refusal(Condition.PRECONDITION, f"topic {put.resource_locator!r} {topic.state.value}")
        ontology = OntologyType(topic.question.ontology_tag, payload, topic.question.serialization_format)
        with refuse_invalid():
            writer = owners[0].session.topic(topic.name, ontology, topic.question.user_metadata)
        topic.state = _State.UPLOADING
        return owners[0], topic, writer

    def _open_sessions(self, sequence: str) -> tuple[OpenSession, ...]:
        return tuple(each for each in self._sessions.values() if each.sequence == sequence)

    def _topic_names(self, sequence: str) -> set[str]:
        return {topic.name for each in self.of_sequence(sequence) for topic in each.topics.values()}

    def _record_call(self, opened: OpenSession) -> None:
        opened.last_call_s = time.monotonic()
        if opened.uuid not in self._sessions:
            raise Refusal(Condition.PRECONDITION, "the session has ended")

    def _session(self, uuid: str) -> OpenSession:
        if uuid in self._committing or uuid in self._finalized:
            raise Refusal(Condition.PRECONDITION, "the session is already finalized")
        if uuid not in self._sessions:
            raise NotInStore(f"there is no open session {uuid}")
        self._sessions[uuid].last_call_s = time.monotonic()
        return self._sessions[uuid]

    def _discard(self, sessions: Iterable[OpenSession]) -> bool:
        discarded = False
        for opened in sessions:
            del self._sessions[opened.uuid]
            opened.session.discard()
            discarded = True
        return discarded


def _rows(batch: pa.RecordBatch, schema: pa.Schema) -> pa.RecordBatch:
    """Return a client's batch with the columns in the order of `schema`.

    Raises:
        pa.ArrowInvalid: The batch is malformed.
        SinkError: A row has no timestamp.
    """
    complete = validated(batch)
    columns = [complete.column(name) for name in schema.names]
    if complete.column(ENVELOPE.name).null_count:
        raise SinkError(f"a row has no {ENVELOPE.name}")
    return pa.RecordBatch.from_arrays(columns, schema=schema)


def _payload_columns(schema: pa.Schema) -> pa.StructType:
    """Return the columns except the envelope, or refuse a schema without the envelope."""
    with refuse_invalid():
        if schema.get_field_index(ENVELOPE.name) < 0 or schema.field(ENVELOPE.name).type != ENVELOPE.type:
            raise pa.ArrowInvalid("the schema has no column timestamp_ns with the type int64")
    return pa.struct([column for column in schema if column.name != ENVELOPE.name])
