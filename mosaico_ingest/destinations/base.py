"""This file is the destination's seam: a sink opens a session, a session opens topics, a topic takes batches."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

import pyarrow as pa
import pyarrow.compute as pc
from msgspec import Struct

from mosaico_ingest import protocol
from mosaico_ingest.errors import SequenceExists, SinkError
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.ontology.types import OntologyType

__all__ = [
    "ENVELOPE",
    "MemorySequence",
    "MemorySink",
    "MemoryTopic",
    "Session",
    "Sink",
    "StoredTopic",
    "TopicWriter",
    "check_batch",
    "check_same_type",
    "sequence_exists",
    "topic_schema",
]

ENVELOPE = pa.field("timestamp_ns", pa.int64(), nullable=False)
"""The first column of every batch: when the message was recorded, ns since the epoch."""


class StoredTopic(Struct, frozen=True):
    """What the destination says it holds of one topic of this session after the commit."""

    topic: str
    """The name as it was given."""
    rows: int
    start_ns: int | None
    end_ns: int | None
    """The largest time stamp, inclusive."""
    stored_bytes: int
    checksum: str | None = None
    """Of the values of its rows, where the destination makes one."""


class TopicWriter(Protocol):
    """Takes the batches of one topic."""

    def write(self, batch: pa.RecordBatch) -> None:
        """Append rows: `timestamp_ns` first, then the ontology's columns.

        Raises:
            SinkError: The destination refused them; nothing of this batch is stored.
        """
        ...


class Session(Protocol):
    """One writing session of a sequence; what it wrote becomes visible at once, when it ends."""

    def topic(self, name: str, ontology: OntologyType, metadata: Mapping[str, Any]) -> TopicWriter:
        """Open a topic; once per name and session.

        Raises:
            SinkError: The destination refuses the name, the metadata or the type.
        """
        ...

    def note_error(self, message: str, *, topic: str | None = None) -> None:
        """Attach an error to the sequence, or to one of its topics, where readers of the destination see it."""
        ...

    def stored(self) -> tuple[StoredTopic, ...]:
        """Return what the destination holds, asked from it anew; only after a commit."""
        ...


class Sink(Protocol):
    """A place sequences go to."""

    def open(
        self, sequence: str, metadata: Mapping[str, Any], *, if_exists: IfExists = IfExists.FAIL
    ) -> AbstractContextManager[Session]:
        """Open a session; leaving it normally commits, leaving it by an exception discards what it wrote.

        A taken name: `fail` and `skip` refuse it (to skip is the caller's decision), `append` adds a session
        to the sequence, `replace` swaps the old one for the new one at the commit.

        Raises:
            SequenceExists: The name is taken and `if_exists` is `fail` or `skip`.
            SinkError: The destination refuses the name or the metadata.
        """
        ...


def topic_schema(ontology: OntologyType) -> pa.Schema:
    """Return the columns of a topic: the envelope, then those of its type."""
    return pa.schema([ENVELOPE, *ontology.struct])


def sequence_exists(sequence: str) -> SequenceExists:
    """Return the error for a name that is taken."""
    return SequenceExists(
        "the sequence exists",
        where=sequence,
        hint="choose another name, or set sequence.if_exists: skip (where the content is the same), append or replace;"
        " `ingest bag` has --if-exists",
    )


def check_batch(batch: pa.RecordBatch, schema: pa.Schema, *, where: str) -> None:
    """Raise SinkError where the batch has not exactly the topic's columns, or a row without a time stamp."""
    if not batch.schema.equals(schema):
        for given, wanted in zip(batch.schema, schema, strict=False):
            if not given.equals(wanted):
                raise SinkError(f"column is {given}, the topic's is {wanted}", where=where)
        raise SinkError(f"batch has columns {batch.schema.names}, the topic has {schema.names}", where=where)
    if batch.column(0).null_count:
        raise SinkError("a row has no timestamp_ns", where=where)


def check_same_type(held: OntologyType, given: OntologyType, *, where: str) -> None:
    """Raise SinkError where rows of `given` cannot join a topic that holds `held`."""
    if (held.tag, held.fingerprint) != (given.tag, given.fingerprint):
        raise SinkError(
            f"the topic holds {held.tag} ({held.fingerprint}), not {given.tag} ({given.fingerprint})",
            where=where,
            hint="rename it in topic_settings, or replace the sequence",
        )


@dataclass(slots=True)
class MemoryTopic:
    """A topic held in memory; it is its own writer."""

    name: str
    ontology: OntologyType
    metadata: Mapping[str, Any]
    batches: list[pa.RecordBatch] = field(default_factory=list[pa.RecordBatch])

    def write(self, batch: pa.RecordBatch) -> None:
        """Append the batch."""
        check_batch(batch, topic_schema(self.ontology), where=self.name)
        self.batches.append(batch)

    def table(self) -> pa.Table:
        """Return all rows in the order they came."""
        return pa.Table.from_batches(self.batches, topic_schema(self.ontology))

    def stored(self, given: str) -> StoredTopic:
        """Return what is held, under the name the caller knows."""
        table = self.table()
        span = pc.min_max(table.column(0))
        return StoredTopic(given, table.num_rows, span["min"].as_py(), span["max"].as_py(), table.nbytes)


@dataclass(slots=True)
class MemorySequence:
    """A sequence held in memory."""

    metadata: Mapping[str, Any]
    topics: dict[str, MemoryTopic] = field(default_factory=dict[str, MemoryTopic])
    errors: list[tuple[str | None, str]] = field(default_factory=list[tuple[str | None, str]])
    """Topic or None, and the message."""


@dataclass(slots=True)
class _MemorySession:
    sequence: MemorySequence
    held: Mapping[str, MemoryTopic]
    """What the sequence has from earlier sessions."""
    given: dict[str, MemoryTopic] = field(default_factory=dict[str, MemoryTopic])

    def topic(self, name: str, ontology: OntologyType, metadata: Mapping[str, Any]) -> MemoryTopic:
        path = protocol.check_topic_name(name)
        protocol.check_metadata(metadata, where=name)
        if path in self.sequence.topics:
            raise SinkError("the topic is open already", where=name)
        if path in self.held:
            check_same_type(self.held[path].ontology, ontology, where=name)
        topic = MemoryTopic(path, ontology, dict(metadata))
        self.sequence.topics[path] = self.given[name] = topic
        return topic

    def note_error(self, message: str, *, topic: str | None = None) -> None:
        self.sequence.errors.append((topic and protocol.check_topic_name(topic), message))

    def stored(self) -> tuple[StoredTopic, ...]:
        return tuple(topic.stored(name) for name, topic in self.given.items())


@dataclass(slots=True)
class MemorySink:
    """Keeps sequences in memory: for tests, notebooks and dry runs of adapters."""

    sequences: dict[str, MemorySequence] = field(default_factory=dict[str, MemorySequence])

    @contextmanager
    def open(
        self, sequence: str, metadata: Mapping[str, Any], *, if_exists: IfExists = IfExists.FAIL
    ) -> Generator[Session, None, None]:
        """Open a session; see `Sink.open`."""
        protocol.check_sequence_name(sequence)
        protocol.check_metadata(metadata, where=sequence)
        self._refuse_taken(sequence, if_exists)
        old = self.sequences.get(sequence) if if_exists is IfExists.APPEND else None
        session = _MemorySession(MemorySequence(dict(metadata)), old.topics if old else {})
        yield session
        self._refuse_taken(sequence, if_exists)
        if old is None:
            self.sequences[sequence] = session.sequence
        else:
            _append(old, session.sequence)

    def _refuse_taken(self, sequence: str, if_exists: IfExists) -> None:
        if sequence in self.sequences and if_exists in {IfExists.FAIL, IfExists.SKIP}:
            raise sequence_exists(sequence)


def _append(old: MemorySequence, new: MemorySequence) -> None:
    for name, topic in new.topics.items():
        if name in old.topics:
            old.topics[name].batches += topic.batches
        else:
            old.topics[name] = topic
    old.errors += new.errors
