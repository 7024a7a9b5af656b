"""A sink that keeps sequences in memory, for tests, notebooks and samples."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from mosaico_ingest import protocol
from mosaico_ingest.destinations import (
    Session,
    StoredTopic,
    check_batch,
    check_same_type,
    replacement_is_incomplete,
    sequence_exists,
    topic_schema,
    with_offsets,
)
from mosaico_ingest.errors import SinkError
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.ontology.registry import OntologyType


@dataclass(slots=True)
class MemoryTopic:
    """A topic in memory; it is its own writer."""

    name: str
    ontology: OntologyType
    metadata: Mapping[str, Any]
    batches: list[pa.RecordBatch] = field(default_factory=list[pa.RecordBatch])

    def write(self, batch: pa.RecordBatch) -> None:
        """Append the batch."""
        check_batch(batch, topic_schema(self.ontology), where=self.name)
        self.batches.append(with_offsets(batch))

    def table(self) -> pa.Table:
        """Return all rows in the order in which they were written."""
        return pa.Table.from_batches(self.batches, topic_schema(self.ontology))


@dataclass(slots=True)
class MemorySequence:
    """A sequence in memory."""

    metadata: Mapping[str, Any]
    topics: dict[str, MemoryTopic] = field(default_factory=dict[str, MemoryTopic])
    errors: list[tuple[str | None, str]] = field(default_factory=list[tuple[str | None, str]])
    """Pairs of topic (None: the sequence) and message."""


@dataclass(slots=True)
class MemorySink:
    """Keeps sequences in memory."""

    sequences: dict[str, MemorySequence] = field(default_factory=dict[str, MemorySequence])

    @contextmanager
    def open(
        self,
        sequence: str,
        metadata: Mapping[str, Any],
        *,
        if_exists: IfExists = IfExists.FAIL,
        amendable: bool = False,  # noqa: ARG002 - every session is
    ) -> Generator[Session, None, None]:
        """Open a session; see `Sink.open`."""
        protocol.check_sequence_name(sequence)
        protocol.check_metadata(metadata, where=sequence)
        self._check_name(sequence, if_exists)
        existing = self.sequences.get(sequence) if if_exists is IfExists.APPEND else None
        session = _MemorySession(MemorySequence(dict(metadata)), existing.topics if existing else {})
        yield session
        if session.name is not None:
            self.sequences[session.name] = session.sequence
            return
        self._check_name(sequence, if_exists)
        ended_early = any(topic is None for topic, _ in session.sequence.errors)
        if if_exists is IfExists.REPLACE and sequence in self.sequences and ended_early:
            raise replacement_is_incomplete(sequence)
        if existing is None:
            self.sequences[sequence] = session.sequence
        else:
            _append(existing, session.sequence)

    def _check_name(self, sequence: str, if_exists: IfExists) -> None:
        if sequence in self.sequences and if_exists in {IfExists.FAIL, IfExists.SKIP}:
            raise sequence_exists(sequence)


@dataclass(slots=True)
class _MemorySession:
    sequence: MemorySequence
    existing: Mapping[str, MemoryTopic]
    """The topics that earlier sessions wrote."""
    topics: dict[str, MemoryTopic] = field(default_factory=dict[str, MemoryTopic])
    """The topics of this session, by the name that was passed to `topic`."""
    name: str | None = None
    """The name of the sequence, if `amend` changed it."""

    def amend(self, metadata: Mapping[str, Any], *, sequence: str | None = None) -> None:
        protocol.check_metadata(metadata, where=sequence or "")
        self.sequence.metadata = dict(metadata)
        self.name = sequence and protocol.check_sequence_name(sequence)

    def topic(self, name: str, ontology: OntologyType, metadata: Mapping[str, Any]) -> MemoryTopic:
        path = protocol.check_topic_name(name)
        protocol.check_metadata(metadata, where=name)
        if path in self.sequence.topics:
            raise SinkError("the topic is already open", where=name)
        if path in self.existing:
            check_same_type(self.existing[path].ontology, ontology, where=name)
        topic = MemoryTopic(path, ontology, dict(metadata))
        self.sequence.topics[path] = self.topics[name] = topic
        return topic

    def note_error(self, message: str, *, topic: str | None = None) -> None:
        self.sequence.errors.append((topic and protocol.check_topic_name(topic), message))

    def stored(self) -> tuple[StoredTopic, ...]:
        return tuple(_stored(name, topic.table()) for name, topic in self.topics.items())


def _stored(name: str, rows: pa.Table) -> StoredTopic:
    times = pc.min_max(rows.column(0))
    return StoredTopic(name, rows.num_rows, times["min"].as_py(), times["max"].as_py(), rows.nbytes)


def _append(sequence: MemorySequence, new: MemorySequence) -> None:
    for name, topic in new.topics.items():
        if name in sequence.topics:
            sequence.topics[name].batches += topic.batches
        else:
            sequence.topics[name] = topic
    sequence.errors += new.errors
