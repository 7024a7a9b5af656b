"""Flights of rows: information, tickets and endpoints of stored topics, and the open sessions of uploads."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any
from uuid import uuid4

import pyarrow as pa
import pyarrow.flight as fl

from mosaico_ingest import protocol
from mosaico_ingest.destinations import ENVELOPE, validated, with_offsets
from mosaico_ingest.destinations.store.files import NotInStore
from mosaico_ingest.destinations.store.model import SequenceInfo, SessionInfo, TopicInfo
from mosaico_ingest.destinations.store.session import StoreSession, StoreTopic
from mosaico_ingest.destinations.store.store import Store, Window, count, scan
from mosaico_ingest.errors import SinkError
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.protocol import messages
from mosaico_ingest.protocol.errors import Condition
from mosaico_ingest.protocol.messages import JSON, Body, Interval
from mosaico_ingest.serve.guard import Refusal, refuse_invalid

_BUFFER_BYTES = 96 << 20
"""Maximum size of the buffered rows per session, in bytes."""
_MAX_SESSIONS = 128
"""Maximum number of open sessions, each of which keeps file descriptors."""
_ABANDONED_S = 60.0
"""Idle time in seconds after which a session may be discarded for a new one if the limit is reached."""
_MESSAGE_BYTES = 16 << 20
"""Target size of one response message, in bytes."""


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


class Extent(Body):
    """The size of a topic, with the field names of clients before 0.7."""

    chunks_number: int
    total_bytes: int
    timestamp: Interval | None


class OlderTopicInfo(messages.TopicInfo):
    """The application metadata of a topic, for clients of all versions."""

    info: Extent


def sequence_schema(sequence: SequenceInfo) -> pa.Schema:
    """Return a schema without columns, with the metadata of the sequence."""
    return _with_metadata(pa.schema([]), {"context": "sequence", "user_metadata": sequence.metadata})


def topic_schema(topic: TopicInfo) -> pa.Schema:
    """Return the schema of the topic, with its metadata."""
    properties = {
        "ontology_tag": topic.ontology.tag,
        "serialization_format": topic.ontology.serialization_format.value,
    }
    return _with_metadata(
        topic.schema, {"context": "topic", "properties": properties, "user_metadata": topic.metadata}
    )


def _with_metadata(schema: pa.Schema, metadata: Mapping[str, Any]) -> pa.Schema:
    encoded = {
        f"mosaico:{key}": value if isinstance(value, str) else json.dumps(value)
        for key, value in metadata.items()
    }
    return schema.with_metadata(encoded)


def split_locator(locator: str) -> tuple[str, str | None]:
    """Return the sequence and the topic of a locator; the topic has a leading slash, or is None for a sequence.

    Raises:
        Refusal: A name is not valid.
    """
    sequence, slash, path = locator.partition("/")
    with refuse_invalid():
        protocol.check_sequence_name(sequence)
        return sequence, protocol.check_topic_name(path) if slash else None


class Flights:
    """The responses to read calls, from the store and from open sessions."""

    def __init__(self, store: Store, uploads: Uploads) -> None:
        self._store = store
        self._uploads = uploads

    def listed(self) -> Iterator[fl.FlightInfo]:
        """Yield one entry per sequence of the store."""
        for name in self._store.names():
            yield fl.FlightInfo(pa.schema([]), fl.FlightDescriptor.for_path(name), [], -1, -1)

    def info(self, question: messages.GetInfo, descriptor: fl.FlightDescriptor) -> fl.FlightInfo:
        """Return a sequence with one endpoint per topic, or a topic with its endpoint."""
        name, topic = split_locator(question.resource_locator)
        if topic is not None:
            info = self._store.topic(name, topic)
            sessions = {each.id: each for each in self._store.sequence(name).sessions}
            endpoint = _endpoint(info, sessions, question)
            return fl.FlightInfo(topic_schema(info), descriptor, [endpoint], -1, -1)
        sequence = self._store.sequence(name)
        sessions = {each.id: each for each in sequence.sessions}
        endpoints = [_endpoint(each, sessions, question) for each in sequence.topics]
        committed = {topic.name for topic in sequence.topics}
        endpoints += [
            _open_endpoint(opened, topic)
            for opened in self._uploads.of_sequence(name)
            for topic in tuple(opened.topics.values())
            if topic.name not in committed
        ]
        metadata = JSON.encode(self._sequence_info(sequence))
        schema = sequence_schema(sequence)
        return fl.FlightInfo(schema, descriptor, endpoints, -1, -1, app_metadata=metadata)

    def schema(self, question: messages.GetInfo) -> pa.Schema:
        """Return the schema of a topic, without its metadata."""
        return self._topic(question).schema

    def rows(self, question: messages.GetInfo) -> tuple[pa.Schema, Iterator[pa.RecordBatch]]:
        """Return the schema of a topic, and its rows in time order as batches of about `_MESSAGE_BYTES` or less."""
        topic = self._topic(question)
        rows = scan(topic.segments, topic.schema, _window(question))
        return topic_schema(topic), _slices(rows)

    def _topic(self, question: messages.GetInfo) -> TopicInfo:
        sequence, topic = split_locator(question.resource_locator)
        if topic is None:
            raise Refusal(Condition.INVALID, f"{question.resource_locator!r} is not the locator of a topic")
        return self._store.topic(sequence, topic)

    def _sequence_info(self, sequence: SequenceInfo) -> messages.SequenceInfo:
        finalized = [
            messages.SessionInfo(
                locator=messages.session_locator(sequence.name, session.id),
                created_at_ns=session.created_ns,
                locked=True,
                completed_at_ns=session.completed_ns,
                topics=[_locator(topic) for topic in sequence.topics if topic.session == session.id],
            )
            for session in sequence.sessions
        ]
        opened = [
            messages.SessionInfo(
                locator=each.locator,
                created_at_ns=each.session.created_ns,
                locked=False,
                topics=[each.topic_locator(name) for name in each.topic_names],
            )
            for each in self._uploads.of_sequence(sequence.name)
            if each.locator not in {session.locator for session in finalized}
        ]
        return messages.SequenceInfo(
            resource_locator=sequence.name,
            created_at_ns=sequence.created_ns,
            user_metadata=dict(sequence.metadata),
            sessions=finalized + opened,
        )


def question_of(descriptor: fl.FlightDescriptor) -> messages.GetInfo:
    """Return the question in the command of a descriptor.

    Raises:
        Refusal: The descriptor has no command.
        Malformed: The command is not a question.
    """
    if descriptor.descriptor_type is not fl.DescriptorType.CMD:
        raise Refusal(Condition.INVALID, "the descriptor has no command; send a command descriptor")
    question = JSON.decode(messages.GetInfo, descriptor.command or b"")
    _window(question)
    return question


def _window(question: messages.GetInfo) -> Window:
    start, end = question.timestamp_ns_start, question.timestamp_ns_end
    return Window(start, end)  # a reversed range selects no rows, as on the platform's server


def _locator(topic: TopicInfo) -> str:
    return messages.topic_locator(topic.sequence, topic.name)


def _endpoint(
    topic: TopicInfo, sessions: Mapping[str, SessionInfo], question: messages.GetInfo
) -> fl.FlightEndpoint:
    window = _window(question)
    ticket = question.model_copy(update={"resource_locator": _locator(topic)})
    session = sessions.get(topic.session)
    interval = _interval(topic.start_ns, topic.end_ns)
    description = OlderTopicInfo(
        resource_locator=_locator(topic),
        ontology_tag=topic.ontology.tag,
        serialization_format=topic.ontology.serialization_format,
        user_metadata=dict(topic.metadata),
        created_at_ns=topic.created_ns,
        completed_at_ns=session.completed_ns if session else None,
        locked=True,
        data_info=messages.DataInfo(
            interval=interval,
            total_row_count=topic.rows,
            total_bytes=topic.stored_bytes,
            total_chunks_count=len(topic.segments),
        ),
        info=Extent(chunks_number=len(topic.segments), total_bytes=topic.stored_bytes, timestamp=interval),
        time_window_info=None if window == Window() else _time_window(topic, window),
    )
    return fl.FlightEndpoint(JSON.encode(ticket), [], None, JSON.encode(description))


def _open_endpoint(opened: OpenSession, topic: OpenTopic) -> fl.FlightEndpoint:
    """Return the endpoint of a topic whose session is open; its rows cannot be read yet."""
    question = topic.question
    locator = opened.topic_locator(topic.name)
    description = OlderTopicInfo(
        resource_locator=locator,
        ontology_tag=question.ontology_tag,
        serialization_format=question.serialization_format,
        user_metadata=dict(question.user_metadata),
        created_at_ns=opened.session.created_ns,
        locked=False,
        data_info=messages.DataInfo(total_row_count=0, total_bytes=0, total_chunks_count=0),
        info=Extent(chunks_number=0, total_bytes=0, timestamp=None),
    )
    ticket = messages.GetInfo(resource_locator=locator)
    return fl.FlightEndpoint(JSON.encode(ticket), [], None, JSON.encode(description))


def _time_window(topic: TopicInfo, window: Window) -> messages.TimeWindow:
    rows, start_ns, end_ns = count(topic.segments, topic.schema, window)
    return messages.TimeWindow(interval=_interval(start_ns, end_ns), row_count=rows)


def _interval(start_ns: int | None, end_ns: int | None) -> messages.Interval | None:
    if start_ns is None or end_ns is None:
        return None
    return messages.Interval(start_ns=start_ns, end_ns=end_ns)


def _slices(batches: Iterator[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
    """Slice batches so that one message stays well below the limit of clients, unless one row exceeds it."""
    for batch in map(with_offsets, batches):
        rows = max(1, batch.num_rows * _MESSAGE_BYTES // max(1, batch.nbytes))
        for start in range(0, batch.num_rows, rows):
            yield batch.slice(start, rows)
