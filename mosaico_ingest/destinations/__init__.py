"""Destinations: the sequence, its topics and Arrow batches in, a committed sequence out.

This module defines the interfaces of a destination and the registry that finds the destination of a target; each
subpackage implements them for one kind. The package must not depend on recordings, message definitions or adapters.

A package adds a destination with an entry point of the group `mosaico_ingest.destinations`:

    [project.entry-points."mosaico_ingest.destinations"]
    lake = "my_package.lake:open_lake"

The name selects it in a manifest (`target: {type: lake, options: {…}}`). The object is called with the options, a
mapping, and the folder of the manifest, and returns a `Destination`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Generator, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeAlias

import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.errors import IngestError, ManifestError, SequenceExists, SinkError
from mosaico_ingest.findings import Finding, suggest_names
from mosaico_ingest.job.values import (
    IfExists,
    PluginTarget,
    ServerTarget,
    SessionLevelErrorPolicy,
    StoreTarget,
    Target,
)
from mosaico_ingest.ontology.registry import OntologyType

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
    entry point group `mosaico_ingest.destinations`; see the module.
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


def validated(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Return a received batch that is safe to process.

    Raises:
        pa.ArrowInvalid: The buffers are inconsistent, for example because offsets are out of range.
    """
    batch.validate(full=True)
    return with_offsets(batch)


def with_offsets(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Return the batch with complete offsets in every zero-length array; other arrays are not copied.

    Writers such as arrow-rs omit these offsets. pyarrow accepts such arrays, but `nbytes`, `get_total_buffer_size` and
    `offsets` read past the end of the missing buffer, which crashes the process.
    """
    columns = [_with_offsets(column) for column in batch.columns]
    if all(new is old for new, old in zip(columns, batch.columns, strict=True)):
        return batch
    return pa.RecordBatch.from_arrays(columns, schema=batch.schema)


def has_nested_lists(schema: pa.Schema) -> bool:
    """Return whether a column has a list inside a list, so that its batches may lack offsets."""
    return any(_list_depth(field.type) > 1 for field in schema)


def _with_offsets(array: Any) -> Any:  # noqa: ANN401 - any array class
    kind = array.type
    if len(array) == 0:
        return pa.array([], kind) if kind.num_fields else array
    if isinstance(kind, pa.StructType):
        return _complete_struct(array)
    if isinstance(kind, pa.ListType | pa.LargeListType | pa.FixedSizeListType | pa.MapType):
        return _complete_list(array)
    return array


def _complete_struct(array: Any) -> Any:  # noqa: ANN401 - a struct array
    children = [array.field(i) for i in range(array.type.num_fields)]
    complete = [_with_offsets(child) for child in children]
    if all(new is old for new, old in zip(complete, children, strict=True)):
        return array
    # `field` has applied the offset of the struct to its children
    mask = array.is_null() if array.null_count else None
    return pa.StructArray.from_arrays(complete, fields=list(array.type), mask=mask)


def _complete_list(array: Any) -> Any:  # noqa: ANN401 - a list or map array
    values = array.values
    complete = _with_offsets(values)
    if complete is values:
        return array
    buffers = array.buffers()[: 1 if isinstance(array.type, pa.FixedSizeListType) else 2]
    return pa.Array.from_buffers(array.type, len(array), buffers, array.null_count, array.offset, [complete])


def _list_depth(kind: Any) -> int:  # noqa: ANN401 - any Arrow type
    """Return the maximum number of nested list types."""
    inner = max((_list_depth(kind.field(i).type) for i in range(kind.num_fields)), default=0)
    return inner + (not isinstance(kind, pa.StructType) and kind.num_fields > 0)


ENTRY_POINTS = "mosaico_ingest.destinations"

DestinationFactory: TypeAlias = Callable[[Mapping[str, Any], Path], Destination]
"""Creates a destination from the options of a manifest and the manifest's folder."""
KeepOpen: TypeAlias = Callable[[Target], None]


def destination_of(target: Target) -> Destination:
    """Return the destination that a target selects.

    Raises:
        ManifestError: No installed package provides this type of destination, or it rejects the options.
    """
    return _FACTORIES.get(target.kind, _plugin)(target)


@contextmanager
def keep_destinations_open() -> Generator[KeepOpen]:
    """Yield a function that keeps a target open until the context ends.

    A batch of recordings uses it because closing a SQLite catalog for the last time costs a checkpoint.
    """
    locations: set[tuple[str, str]] = set()
    with ExitStack() as stack:

        def keep(target: Target) -> None:
            with suppress(IngestError):  # opening the destination for the run reports the error
                destination = destination_of(target)
                location = (destination.kind, destination.describe())
                context = None if location in locations else destination.keep_open()
                if context is not None:
                    stack.enter_context(context)
                    locations.add(location)

        yield keep


def _store(target: StoreTarget) -> Destination:
    from mosaico_ingest.destinations.store.destination import StoreDestination  # noqa: PLC0415 - Parquet is slow to import

    return StoreDestination(target.path, target.compression)


def _server(target: ServerTarget) -> Destination:
    from mosaico_ingest.destinations.server.destination import ServerDestination  # noqa: PLC0415 - Flight is slow to import

    return ServerDestination(target)


def _plugin(target: PluginTarget) -> Destination:
    from importlib.metadata import entry_points  # noqa: PLC0415 - slow to import, and only plugins need it

    factories = {entry.name: entry for entry in entry_points(group=ENTRY_POINTS)}
    if target.kind not in factories:
        raise ManifestError(
            f"no destination of type {target.kind!r} is installed",
            where="target.type",
            hint=suggest_names(factories, [target.kind]) or "install the package that provides it",
        )
    try:
        factory: DestinationFactory = factories[target.kind].load()
        return factory(target.options, target.base_dir)
    except IngestError:
        raise
    except Exception as error:
        raise SinkError(
            f"the destination {target.kind!r} cannot be created: {type(error).__name__}: {error}",
            where=factories[target.kind].value,
            hint="check target.options and the package that provides the destination",
        ) from error


_FACTORIES: Mapping[str, Callable[[Any], Destination]] = {
    StoreTarget.kind: _store,
    ServerTarget.kind: _server,
}
