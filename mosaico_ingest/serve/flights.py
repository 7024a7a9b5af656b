"""Flight information of sequences and topics: endpoints, tickets and rows, with the fields of clients before 0.7."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

import pyarrow as pa
import pyarrow.flight as fl

from mosaico_ingest import protocol
from mosaico_ingest.destinations.base import with_offsets
from mosaico_ingest.destinations.store.model import SequenceInfo, SessionInfo, TopicInfo
from mosaico_ingest.destinations.store.store import Store, Window, count, scan
from mosaico_ingest.protocol import messages
from mosaico_ingest.protocol.errors import Condition
from mosaico_ingest.protocol.messages import JSON, Body, Interval
from mosaico_ingest.serve.errors import Refusal, refuse_invalid
from mosaico_ingest.serve.uploads import OpenSession, OpenTopic, Uploads


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


_MESSAGE_BYTES = 16 << 20
"""Target size of one response message, in bytes."""


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
