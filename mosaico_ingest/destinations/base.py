"""The interfaces of a destination: `Destination`, `Sink`, `Session` and `TopicWriter`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, ClassVar, Protocol

import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.errors import SequenceExists, SinkError
from mosaico_ingest.findings import Finding
from mosaico_ingest.job.values import IfExists, SessionLevelErrorPolicy
from mosaico_ingest.ontology.types import OntologyType

ENVELOPE = pa.field("timestamp_ns", pa.int64(), nullable=False)
"""The first column of every batch: the log time of the message, ns since the epoch."""


class ExistingSession(Struct, frozen=True):
    """A committed session of a stored sequence."""

    id: str
    metadata: Mapping[str, Any]


class ExistingTopic(Struct, frozen=True):
    """A topic of a stored sequence."""

    session: str
    """The id of the session that created it."""
    ontology: OntologyType
    metadata: Mapping[str, Any]


class FamilyTopic(Struct, frozen=True):
    """A stored topic of a sequence family."""

    sequence: str
    name: str
    metadata: Mapping[str, Any]


class ExistingSequence(Struct, frozen=True):
    """The content of a sequence that a destination already has."""

    name: str
    complete: bool
    """False if a run ended early with an error, or if a session was never finished."""
    sessions: tuple[ExistingSession, ...]
    topics: Mapping[str, ExistingTopic] = {}
    """By name, with the leading slash; empty if the destination does not list types."""
    has_all_sessions: bool = True
    """False if `sessions` holds only the metadata of the first session."""
    finished: bool = True
    """False if a session is not finished: another run may still be writing it, or was killed."""


class DestinationStatus(Struct, frozen=True):
    """The state of a destination before a run; None for a value that is unknown."""

    exists: bool | None = None
    """Whether the store exists or the server responds."""
    sequence: ExistingSequence | None = None
    """The sequence of the requested name, if the destination has one."""
    problem: str | None = None
    """The reason why the destination cannot be written."""
    free_bytes: int | None = None


class Attached(Struct, frozen=True):
    """A file that belongs to a sequence."""

    name: str
    media_type: str
    log_ns: int
    """The time at which the recorder received it, ns since the epoch."""
    create_ns: int
    """The time at which it was created, ns since the epoch; 0 if unknown."""


class Destination(ABC):
    """A store, a server or another system that sequences are written to.

    A destination is cheap to create and connects only when a method is called. Packages add destinations through the
    entry point group `mosaico_ingest.destinations`; see `registry`.
    """

    kind: ClassVar[str]
    """The name of this type of destination in plans."""
    can_attach: ClassVar[bool] = False
    """True if its sessions are `AttachableSession`s, which store files of the sequence."""
    can_amend: ClassVar[bool] = False
    """True if its sinks accept `amendable=True` and then open an `AmendableSession`."""
    max_commits: int = 1
    """Maximum number of sessions that are written before `commit` commits them together."""
    replaces_atomically: ClassVar[bool] = True
    """True if `replace` keeps the old sequence until the new one is committed."""

    @abstractmethod
    def describe(self, *, folder: Path | None = None) -> str:
        """Return the location for people, without credentials; paths are relative to `folder` if it is given."""

    @abstractmethod
    def inspect(self, sequence: str, *, connect: bool) -> DestinationStatus:
        """Return the current state, with the sequence of this name; network access requires `connect`."""

    @abstractmethod
    def find(self, sequence: str) -> ExistingSequence | None:
        """Return the stored sequence of this name, or None.

        Raises:
            SinkError: The destination cannot be read.
        """

    def find_all(self, sequences: Collection[str]) -> dict[str, ExistingSequence]:
        """Return the stored sequences with these names; `topics` may be empty.

        Raises:
            SinkError: The destination cannot be read.
        """
        existing = ((name, self.find(name)) for name in sequences)
        return {name: sequence for name, sequence in existing if sequence is not None}

    @abstractmethod
    def open_sink(self, *, buffer_bytes: int) -> Sink:
        """Return the sink for this destination; one session buffers at most about `buffer_bytes`.

        A session that ends normally is committed, at the latest by `commit`.

        Raises:
            SinkError: The destination cannot be opened.
        """

    def commit(self, sessions: Sequence[Session]) -> list[Exception | None]:
        """Commit sessions of `open_sink` that ended normally; return the error of each session, or None.

        This default is for sinks that commit a session when it ends.
        """
        return [None] * len(sessions)

    def discard(self, sessions: Sequence[Session]) -> None:  # noqa: B027 - nothing to do for the same sinks
        """Discard sessions of `open_sink` that ended normally and are not committed."""

    def preflight(self, sequence: str, on_error: SessionLevelErrorPolicy) -> tuple[Finding, ...]:  # noqa: ARG002 - for subclasses
        """Return warnings about a run, for example if it could not follow its session error policy; may connect."""
        return ()

    def family_topics(self, family: str | None, names: Collection[str]) -> tuple[FamilyTopic, ...] | None:  # noqa: ARG002 - for subclasses
        """Return the topics with these names that sessions of the family created, oldest session first.

        None means that the destination cannot list topics with their metadata.
        """
        return None

    def delete_sessions(self, sequence: str, sessions: Collection[str]) -> bool:  # noqa: ARG002 - for subclasses
        """Delete some sessions of a sequence; return False if the destination can only replace whole sequences."""
        return False

    @property
    def local_folder(self) -> Path | None:
        """The folder on this machine that is written to, or None for a destination reached by network."""
        return None

    def keep_open(self) -> AbstractContextManager[object] | None:
        """Return a context that makes subsequent calls cheaper, or None if there is nothing to keep open yet."""
        return None


class Sink(Protocol):
    """Opens writing sessions at a destination."""

    def open(
        self, sequence: str, metadata: Mapping[str, Any], *, if_exists: IfExists = IfExists.FAIL
    ) -> AbstractContextManager[Session]:
        """Open a session. A normal exit commits it; an exception discards everything it wrote.

        If the sequence exists, `fail` and `skip` raise, `append` adds a session to the sequence, and `replace` swaps the
        old sequence for the new one at the commit.

        Raises:
            SequenceExists: The sequence exists and `if_exists` is `fail` or `skip`.
            SinkError: The destination refuses the name or the metadata.
        """
        ...


class Session(Protocol):
    """A writing session of one sequence; its topics become visible atomically at the commit."""

    def topic(self, name: str, ontology: OntologyType, metadata: Mapping[str, Any]) -> TopicWriter:
        """Open a topic; once per name and session.

        Raises:
            SinkError: The destination refuses the name, the metadata or the type.
        """
        ...

    def note_error(self, message: str, *, topic: str | None = None) -> None:
        """Attach an error to the sequence, or to one of its topics, where readers of the destination see it.

        An error of the sequence marks it as incomplete. A session with such an error cannot replace a stored sequence:
        its commit raises, and the stored sequence stays.
        """
        ...

    def stored(self) -> tuple[StoredTopic, ...]:
        """Return the stored content, read from the destination again; only after a commit."""
        ...


class AttachableSession(Session, Protocol):
    """A session that stores files of the sequence next to its topics."""

    def attach(self, file: Attached, chunks: Iterable[bytes]) -> None:
        """Store a file; an exception of `chunks` leaves no file behind.

        Raises:
            SinkError: The file cannot be written.
        """
        ...


class AmendableSession(Session, Protocol):
    """A session whose metadata and name may change until the commit."""

    def amend(self, metadata: Mapping[str, Any], *, sequence: str | None = None) -> None:
        """Replace the metadata and, with `sequence`, store the content under this name.

        A stored sequence of the new name is replaced at the commit.

        Raises:
            SinkError: The destination refuses the name or the metadata.
        """
        ...


class AmendableSink(Protocol):
    """A sink whose sessions can be amendable."""

    def open(
        self,
        sequence: str,
        metadata: Mapping[str, Any],
        *,
        if_exists: IfExists = IfExists.FAIL,
        amendable: bool = False,
    ) -> AbstractContextManager[Session]:
        """Open a session; see `Sink.open`. With `amendable`, it is an `AmendableSession`."""
        ...


class TopicWriter(Protocol):
    """Writes the batches of one topic."""

    def write(self, batch: pa.RecordBatch) -> None:
        """Append rows: `timestamp_ns` first, then the columns of the ontology type.

        Raises:
            SinkError: The destination refuses the rows; none of this batch are stored.
        """
        ...


class StoredTopic(Struct, frozen=True):
    """The content of one topic that a destination reports after the commit."""

    topic: str
    """The name that was passed to `Session.topic`."""
    rows: int
    start_ns: int | None
    end_ns: int | None
    """The largest time stamp, inclusive."""
    stored_bytes: int
    checksum: str | None = None
    """Checksum of the row values; None if the destination has none."""


def topic_schema(ontology: OntologyType) -> pa.Schema:
    """Return the columns of a topic: the envelope, then the columns of its type."""
    return pa.schema([ENVELOPE, *ontology.struct])


def sequence_exists(sequence: str) -> SequenceExists:
    """Return the error for a sequence name that is already in use."""
    return SequenceExists(
        "the sequence already exists",
        where=sequence,
        hint="choose another name, or set sequence.if_exists: skip (if the content is the same), append or replace;"
        " `ingest bag` has --if-exists",
    )


def replacement_is_incomplete(sequence: str) -> SinkError:
    """Return the error for a session that must not replace a stored sequence because it ended early."""
    return SinkError(
        "the new content is incomplete, so the stored sequence was not replaced",
        where=sequence,
        hint="run again to replace it",
    )


def check_batch(batch: pa.RecordBatch, schema: pa.Schema, *, where: str) -> None:
    """Raise SinkError if the columns of a batch differ from `schema` or a row has no time stamp."""
    if not batch.schema.equals(schema):
        for actual, expected in zip(batch.schema, schema, strict=False):
            if not actual.equals(expected):
                raise SinkError(f"column is {actual}, expected {expected}", where=where)
        raise SinkError(f"batch has columns {batch.schema.names}, expected {schema.names}", where=where)
    if batch.column(0).null_count:
        raise SinkError("a row has no timestamp_ns", where=where)


def check_same_type(existing: OntologyType, new: OntologyType, *, where: str) -> None:
    """Raise SinkError if rows of type `new` cannot be appended to a topic of type `existing`."""
    if (existing.tag, existing.fingerprint) != (new.tag, new.fingerprint):
        raise SinkError(
            f"the topic holds {existing.tag} ({existing.fingerprint}), not {new.tag} ({new.fingerprint})",
            where=where,
            hint="rename the topic in topic_settings, or replace the sequence",
        )
