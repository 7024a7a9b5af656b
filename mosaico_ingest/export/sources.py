"""Sources of exports: sequences of the embedded store or of a Mosaico server."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import pyarrow as pa
import pyarrow.compute as pc
from msgspec import Struct

from mosaico_ingest.destinations.store.model import AttachmentInfo
from mosaico_ingest.errors import SinkError
from mosaico_ingest.findings import suggest_names
from mosaico_ingest.ontology.registry import PLAIN_TYPES, OntologyType
from mosaico_ingest.protocol.messages import TopicInfo as ServerTopic
from mosaico_ingest.protocol.messages import topic_name

if TYPE_CHECKING:
    from mosaico_ingest.destinations.server.client import ServerClient
    from mosaico_ingest.destinations.store import Store

_TIME = "timestamp_ns"
_arrow: Any = pa
"""pyarrow, whose stubs do not accept `type` together with `mask`."""


class SourceTopic(Struct, frozen=True):
    """A topic to export."""

    name: str
    """With its leading slash."""
    ontology: OntologyType
    """The type of its rows; from a server, up to `columns.comparable`."""
    metadata: Mapping[str, Any]
    problem: str = ""
    """The reason why its rows cannot be read; empty if they can."""


class SourceSequence(Protocol):
    """A sequence to export."""

    @property
    def name(self) -> str:
        """The name of the sequence."""
        ...

    @property
    def topics(self) -> Sequence[SourceTopic]:
        """Its topics, sorted by name."""
        ...

    @property
    def metadata(self) -> Mapping[str, Any]:
        """The metadata of the sequence."""
        ...

    @property
    def attachments(self) -> Sequence[AttachmentInfo]:
        """The files of the sequence."""
        ...

    @property
    def bounds(self) -> tuple[int, int]:
        """The first and the last timestamp, nanoseconds; zeros without rows."""
        ...

    def rows(
        self, topic: SourceTopic, start_ns: int | None = None, end_ns: int | None = None
    ) -> Generator[pa.RecordBatch, None, None]:
        """Yield the rows of a topic: `timestamp_ns`, then the columns of its type; the end is exclusive."""
        ...


class StoreSequence:
    """A sequence of the embedded store."""

    def __init__(self, store: Store, name: str) -> None:
        """Look up the sequence.

        Raises:
            SinkError: The sequence does not exist.
        """
        info = store.sequence(name)
        self._store = store
        self.name = info.name
        self.metadata = info.metadata
        self.attachments = info.attachments
        self.topics = tuple(SourceTopic(topic.name, topic.ontology, topic.metadata) for topic in info.topics)
        self.bounds = info.start_ns or 0, info.end_ns or 0

    def rows(
        self, topic: SourceTopic, start_ns: int | None = None, end_ns: int | None = None
    ) -> Generator[pa.RecordBatch, None, None]:
        """Yield the rows of a topic in the order of their timestamps."""
        with self._store.scan(self.name, topic.name, start_ns=start_ns, end_ns=end_ns) as reader:
            yield from reader


class ServerSequence:
    """A sequence of a Mosaico server. Its rows are streamed; each topic holds one message of the server at a time."""

    def __init__(self, client: ServerClient, name: str) -> None:
        """Look up the sequence and its topics.

        Raises:
            SinkError: The sequence does not exist, or the server refuses the request.
        """
        self._client = client
        self.name = name
        handler = client.find(name)
        if handler is None:
            hint = suggest_names(client.sequence_names(), [name])
            raise SinkError(f"there is no sequence {name!r}", where=str(client.address), hint=hint)
        self.metadata: Mapping[str, Any] = handler.user_metadata or {}
        self.attachments: tuple[AttachmentInfo, ...] = ()
        self._infos = {topic_name(info.resource_locator): info for info in client.topic_infos(name)}
        self.topics = tuple(self._topic(name, info) for name, info in sorted(self._infos.items()))

    @property
    def bounds(self) -> tuple[int, int]:
        """The first and the last timestamp of all topics; zeros if the server does not report them."""
        intervals = [info.data_info.interval for info in self._infos.values() if info.data_info]
        reported = [interval for interval in intervals if interval is not None]
        start_ns = min((interval.start_ns for interval in reported), default=0)
        return start_ns, max((interval.end_ns for interval in reported), default=0)

    def rows(
        self, topic: SourceTopic, start_ns: int | None = None, end_ns: int | None = None
    ) -> Generator[pa.RecordBatch, None, None]:
        """Yield the rows of a topic in the order in which they were uploaded."""
        info = self._infos[topic.name]
        if info.data_info is None or info.data_info.total_row_count:
            yield from self._client.rows(info.resource_locator, start_ns, end_ns)

    def _topic(self, name: str, info: ServerTopic) -> SourceTopic:
        if not info.locked:
            empty = OntologyType(info.ontology_tag, pa.struct([]), info.serialization_format)
            return SourceTopic(name, empty, info.user_metadata, "its upload is not finished")
        schema = self._client.topic_schema(info.resource_locator)
        struct = comparable(pa.struct([field for field in schema if field.name != _TIME]))
        ontology = OntologyType(info.ontology_tag, struct, info.serialization_format)
        return SourceTopic(name, ontology, info.user_metadata)


def comparable(kind: Any) -> Any:  # noqa: ANN401 - any Arrow type
    """Return a type without the properties that a server does not keep: nullability, and the layout of texts and lists."""
    if pa.types.is_struct(kind):
        return pa.struct([pa.field(field.name, comparable(field.type)) for field in kind])
    if pa.types.is_list(kind) or pa.types.is_large_list(kind):
        return pa.list_(comparable(kind.value_type))
    if pa.types.is_fixed_size_list(kind):
        return pa.list_(comparable(kind.value_type), kind.list_size)
    return PLAIN_TYPES.get(kind, kind)


def as_type(array: Any, kind: Any, name: str = "") -> Any:  # noqa: ANN401 - any array and type
    """Return a column in a type that is equal up to `comparable`; `name` is used in errors.

    Raises:
        SinkError: The types differ, or a value is null where the type requires one.
    """
    if array.type == kind:
        return array
    mask = pc.is_null(array) if array.null_count else None
    if pa.types.is_struct(kind) and pa.types.is_struct(array.type):
        children = [
            as_type(array.field(array.type.get_field_index(field.name)), field.type, f"{name}.{field.name}")
            for field in kind
        ]
        return _arrow.StructArray.from_arrays(children, fields=list(kind), mask=mask)
    if pa.types.is_fixed_size_list(kind) and pa.types.is_fixed_size_list(array.type):
        values = array.values.slice(array.offset * kind.list_size, len(array) * kind.list_size)
        elements = as_type(values, kind.value_type, f"{name}[]")
        return _arrow.FixedSizeListArray.from_arrays(elements, type=kind, mask=mask)
    if pa.types.is_list(kind) or pa.types.is_large_list(kind):
        elements = as_type(array.values, kind.value_type, f"{name}[]")
        large = pa.types.is_large_list(kind)
        offsets = array.offsets.cast(pa.int64() if large else pa.int32())
        lists = _arrow.LargeListArray if large else _arrow.ListArray
        return lists.from_arrays(offsets, elements, type=kind, mask=mask)
    try:
        return array.cast(kind)
    except (pa.ArrowException, ValueError) as error:
        raise SinkError(f"the column {name} is {array.type}, not {kind}: {error}") from error
