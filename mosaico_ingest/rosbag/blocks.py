"""Message blocks and the contracts between container readers and `Recording`.

A container reader (`SplitReader`) lists the connections of its file and yields `ReadTask`s. Each task reads some bytes
of the file and returns a `ReadResult`: message blocks, and the ranges of the file that it could not read. `Recording`
merges the tasks of all splits by time, and yields `MessageBlock`s whose connection ids are valid in the recording.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from msgspec import Struct, field
from msgspec.structs import force_setattr
from numpy.typing import NDArray

from mosaico_ingest.remote import AnyPath
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded

if TYPE_CHECKING:
    from mosaico_ingest.ontology.model import Time

EARLIEST_NS, LATEST_NS = -(2**63), 2**63 - 1
"""The range of int64 nanosecond timestamps; the latest is in the year 2262."""
FIRST_GROUP_BYTES, MAX_GROUP_LENGTH = 2 << 20, 64
"""Bytes of the first group that `group_by_bytes` yields, and the maximum number of items per group.

Large groups amortize the fixed cost of a read; the first one is small, so that the next stage starts early."""
_FEW_ROWS_PER_LENGTH = 8
"""With fewer messages per distinct length on average, `pack` gathers words instead of copying length by length."""
_MAX_ELEMENT_BYTES = 1 << 12
"""Size up to which numpy copies slices faster as elements of one type than as rows of bytes."""
_MIN_WORD_BYTES, _MAX_WORD_BYTES = 4, 64
"""Range of the word size in which `pack` gathers payloads: it needs one index per word instead of one per byte."""
Bytes = NDArray[np.uint8]
Int64s = NDArray[np.int64]
T = TypeVar("T")
ROSBAG2_RECORD, ROSBAG2_ENTRY = "rosbag2", "serialized_metadata"
"""The metadata record and its entry in which rosbag2 stores the text of `metadata.yaml`."""


class Attachment(Struct, frozen=True):
    """An attachment of a recording; its content is read by `Recording.attachment_chunks`."""

    name: str
    media_type: str
    log_ns: int
    """The time at which the recorder received it, ns since the epoch."""
    create_ns: int
    """The time at which it was created, ns since the epoch; 0 if unknown."""
    size_bytes: int
    has_crc: bool = False
    """Whether the recording has a checksum of the attachment."""
    split: int = 0
    """The number of the split that contains it."""
    offset: int = 0
    """File offset of the content of its record."""
    data_offset: int = 0
    """File offset of its first byte."""


class Encoding(str, Enum):
    """The serialization of a payload."""

    CDR = "cdr"
    """ROS 2: a 4-byte encapsulation header, then aligned little- or big-endian fields."""
    ROS1 = "ros1"
    """ROS 1: packed little-endian fields."""
    PROTOBUF = "protobuf"
    JSON = "json"
    OTHER = "other"
    """Any other encoding (CBOR, FlatBuffers, …): listed, never decoded."""


class ChunkChecksum(str, Enum):
    """The checksum of a chunk of an MCAP file."""

    ABSENT = "absent"
    VALID = "valid"
    WRONG = "wrong"


class Connection(Struct, frozen=True):
    """A connection of a recording: messages of one type and encoding on one topic, merged over all splits.

    A topic has several connections if its messages differ in type, definition or encoding.
    """

    id: int
    """Index in `Recording.connections`."""
    topic: str
    msgtype: str
    """`pkg/msg/Name`, also for ROS 1 and for names in older notations."""
    encoding: Encoding
    count: int | None
    """Number of messages according to the index; None if there is no index."""
    definition: Definition | None
    """None if no definition was found; `problem` then gives the reason."""
    problem: str | None = None
    latched: bool = False
    attributes: dict[str, str] = field(default_factory=dict[str, str])
    """Other properties that the container stores: QoS profiles, caller id, MD5 sum, name of the raw encoding."""


class SplitConnection(Struct, frozen=True):
    """A connection as one split describes it, before its definition is resolved."""

    id: int
    """Unique within the split."""
    topic: str
    msgtype: str
    """In the notation of the file."""
    encoding: Encoding
    ros_version: int
    embedded: Embedded | None
    count: int | None
    """Number of messages according to the index; None if there is no index."""
    latched: bool = False
    attributes: dict[str, str] = field(default_factory=dict[str, str])


class MessageBlock(Struct, frozen=True):
    """n messages of one connection: a contiguous buffer plus offsets, lengths and log times.

    Every start and length has been checked against the buffer.
    """

    connection: int
    """Id of the connection: within the split while a reader builds the block, within the recording afterwards."""
    log_times: Int64s
    """Nanoseconds since the epoch, shape (n,)."""
    data: Bytes
    """The buffer; it may contain bytes that belong to no message of the block."""
    starts: Int64s
    """Index in `data` of the first byte of each payload, shape (n,)."""
    lengths: Int64s
    """Bytes of each payload, shape (n,)."""
    offsets: Int64s
    """Position in the source, for diagnostics: file offset of the record or chunk, or row id; shape (n,)."""
    publish_times: Int64s | None = None
    """Nanoseconds since the epoch, shape (n,); None if they equal the log times, or if the container has none."""
    sequences: Int64s | None = None
    """Sequence numbers, shape (n,); None if all are 0, or if the container has none."""
    payload_bytes: int = -1
    """Sum of the lengths."""

    def __post_init__(self) -> None:
        force_setattr(self, "payload_bytes", int(self.lengths.sum()))

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.log_times)

    def rows(
        self, selection: Int64s | NDArray[np.bool_] | slice, *, connection: int | None = None
    ) -> MessageBlock:
        """Return the selected messages over the same buffer, by default with the same connection."""
        return MessageBlock(
            self.connection if connection is None else connection,
            self.log_times[selection],
            self.data,
            self.starts[selection],
            self.lengths[selection],
            self.offsets[selection],
            None if self.publish_times is None else self.publish_times[selection],
            None if self.sequences is None else self.sequences[selection],
        )

    def payload(self, row: int) -> bytes:
        """Return a copy of the bytes of one message."""
        start = int(self.starts[row])
        return self.data[start : start + int(self.lengths[row])].tobytes()


class UnreadableRange(Struct, frozen=True):
    """A range of a recording from which messages could not be read, or only in an alternative way."""

    offset: int
    """File offset of the record or chunk, or row id."""
    reason: str
    """The expectation that the file violates, in one line."""
    connection: int | None = None
    """Id of the messages' connection; None if unknown."""
    count: int | None = None
    """Number of unreadable messages; None if unknown, 0 if all messages could be read in an alternative way."""
    file: str = ""
    """Path of the file; `Recording` fills it in."""
    start_ns: int | None = None
    """First log time of the range according to its index; None if unknown."""
    end_ns: int | None = None
    """Last log time of the range according to its index, inclusive; None if unknown."""


class ReadRequest(Struct, frozen=True):
    """The messages to read from a split: those of some connections, with start_ns <= log time < end_ns."""

    connections: Collection[int]
    start_ns: int
    end_ns: int
    block_bytes: int
    """Approximate number of bytes to read per task."""
    block_rows: int
    """Maximum number of messages to read per task, if the container is read message by message."""

    def overlaps(self, first_ns: int, last_ns: int) -> bool:
        """Return whether a log time between the two, both inclusive, may be requested."""
        return first_ns < self.end_ns and last_ns >= self.start_ns


class ReadResult(Struct, frozen=True):
    """The blocks that a task read, and the ranges that it could not read."""

    blocks: list[MessageBlock]
    unreadable: list[UnreadableRange]


class ReadTask(Struct, frozen=True):
    """A deferred read of one part of a file; none of its messages is older than `start_ns`."""

    start_ns: int
    load: Callable[[], ReadResult]


class SplitReader(Protocol):
    """The reader of one split: an open file of a recording."""

    path: AnyPath
    """The path that the caller named, even if a temporary copy is read."""
    container: str
    """Name of the container format, see `containers.CONTAINERS`."""
    connections: tuple[SplitConnection, ...]
    message_count: int | None
    """Number of messages according to the index; None if there is no index."""
    start_ns: int | None
    end_ns: int | None
    """Log time of the last message, inclusive."""
    unreadable: list[UnreadableRange]
    """Damage detected while opening the file."""
    notes: list[str]
    """Other remarks about the file, one line each."""

    def read_tasks(self, request: ReadRequest) -> Iterator[ReadTask]:
        """Yield tasks that together read all requested messages, by ascending `start_ns`."""
        ...

    def check_unchanged(self) -> None:
        """Raise if the file has changed since it was opened; called after the last read."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...


@runtime_checkable
class HasMetadataRecords(Protocol):
    """A reader of a container that can contain metadata records."""

    def metadata_records(self) -> dict[str, dict[str, str]]:
        """Return the entries of the metadata records by name."""
        ...


@runtime_checkable
class HasAttachments(Protocol):
    """A reader of a container that can contain attachments."""

    def attachments(self) -> Sequence[Attachment]:
        """Return the attachments without their content."""
        ...

    def damaged_records(self) -> Sequence[str]:
        """Return one line for each attachment and metadata record that cannot be read."""
        ...

    def attachment_chunks(self, attachment: Attachment) -> Iterator[bytes]:
        """Yield the content of an attachment.

        Raises:
            BagError: The content cannot be read, or differs from its checksum; raised after the last chunk.
        """
        ...


class ROSHeader(Struct, frozen=True):
    """The `std_msgs/Header` of a message."""

    stamp_ns: int
    """`stamp` in nanoseconds."""
    frame_id: str
    seq: int | None = None
    """Sequence number; None in ROS 2."""

    @property
    def stamp(self) -> Time:
        """`stamp` as a time of the ontology."""
        from mosaico_ingest.ontology.model import Time  # noqa: PLC0415 - imports pydantic

        return Time.from_nanoseconds(self.stamp_ns)


@dataclass(frozen=True)
class ROSMessage:
    """One decoded message: log time, topic, type and fields by name."""

    bag_timestamp_ns: int
    """Log time, nanoseconds since the epoch."""
    topic: str
    msg_type: str
    """`pkg/msg/Name`."""
    data: dict[str, Any]
    """Nested messages are dictionaries, arrays are lists, `uint8[]`, `byte[]` and `char[]` are `bytes`.

    Empty if the message cannot be decoded."""
    const_data: Mapping[str, Any] | None = dataclasses.field(default=None, compare=False)
    """The constants of the message type by name."""

    @property
    def data_field(self) -> dict[str, Any] | None:
        """`data`, or None if it is empty; the name in SDK 0.7."""
        return self.data or None

    @property
    def timestamp_ns(self) -> int:
        """The same as `bag_timestamp_ns`."""
        return self.bag_timestamp_ns

    @property
    def header(self) -> ROSHeader | None:
        """The message's header; None if the message has no field `header` of type `std_msgs/Header`."""
        match self.data.get("header"):
            case {"stamp": {"sec": int(sec), "nanosec": int(nanosec)}, "frame_id": str(frame_id)} as header:
                seq = header.get("seq")
                return ROSHeader(
                    sec * 1_000_000_000 + nanosec, frame_id, seq if isinstance(seq, int) else None
                )
            case _:
                return None


def undescribed_connections(
    counts: Mapping[int, int] | None, described: Collection[int]
) -> list[UnreadableRange]:
    """Return an unreadable range for each connection that has messages, but no description in the file."""
    return [
        UnreadableRange(
            0, f"{count} messages of connection {connection}, which the file does not describe", count=count
        )
        for connection, count in (counts or {}).items()
        if count and connection not in described
    ]


def group_by_bytes(
    items: Iterable[T], size: Callable[[T], int], group_bytes: int, *, max_length: int = MAX_GROUP_LENGTH
) -> Iterator[list[T]]:
    """Yield groups of consecutive items, limited in length and in bytes.

    The byte limit starts at `FIRST_GROUP_BYTES` and doubles with each group up to `group_bytes`. If `items` raises,
    the items before the error are yielded first.
    """
    group: list[T] = []
    total_bytes, limit_bytes = 0, min(FIRST_GROUP_BYTES, group_bytes)
    try:
        for item in items:
            item_bytes = size(item)
            total_bytes += item_bytes
            if group and (total_bytes > limit_bytes or len(group) == max_length):
                yield group
                group, total_bytes = [], item_bytes
                limit_bytes = min(2 * limit_bytes, group_bytes)
            group.append(item)
    except Exception:
        if group:
            yield group
        raise
    if group:
        yield group


def fixed_slices(data: Bytes, starts: Int64s, size: int) -> Bytes:
    """Return a copy of `data[start : start + size]` for each start, shape (len(starts), size).

    The caller has checked that every slice lies inside the buffer.
    """
    if not 0 < size <= _MAX_ELEMENT_BYTES:
        windows = np.ndarray((len(data) - size + 1, size), np.uint8, data, strides=(1, 1))
        return windows[starts]
    elements = np.ndarray(len(data) - size + 1, f"V{size}", data, strides=1)
    return elements[starts].view(np.uint8).reshape(len(starts), size)


def rows_by_connection(connections: NDArray[np.integer]) -> Iterator[tuple[int, Int64s]]:
    """Yield each connection id with the indices at which it occurs, ascending."""
    order = np.argsort(connections, kind="stable")
    edges = np.flatnonzero(np.diff(connections[order])) + 1
    for rows in np.split(order, edges) if len(order) else []:
        yield int(connections[rows[0]]), rows


def add_selected(block: MessageBlock, request: ReadRequest, result: ReadResult) -> None:
    """Add the messages within the requested time range to `result`."""
    block = _in_time_range(block, request, result.unreadable)
    if len(block):
        result.blocks.append(block)


def add_selected_rows(
    block: MessageBlock,
    rows_of: Iterable[tuple[int, Int64s | slice]],
    request: ReadRequest,
    result: ReadResult,
) -> None:
    """Split a block by connection, and add the messages within the requested time range to `result`."""
    if _is_in_time_range(block, request):
        blocks = [block.rows(rows, connection=connection) for connection, rows in rows_of]
        result.blocks.extend(block for block in blocks if len(block))
        return
    for connection, rows in rows_of:
        add_selected(block.rows(rows, connection=connection), request, result)


def sort_by_time(block: MessageBlock) -> MessageBlock:
    """Return the messages sorted by log time; the sort is stable."""
    times = block.log_times
    if bool((times[1:] >= times[:-1]).all()):
        return block
    return block.rows(np.argsort(times, kind="stable"))


def pack(block: MessageBlock) -> MessageBlock:
    """Return a copy of the messages that does not refer to the original buffers.

    Payloads of equal length are adjacent. If there are many different lengths, payloads are padded to whole words.
    """
    lengths = block.lengths
    shortest, longest = int(lengths.min()), int(lengths.max())
    if shortest == longest:
        data = fixed_slices(block.data, block.starts, shortest).reshape(-1)
        return _with_data(block, data, np.arange(len(block), dtype=np.int64) * shortest)
    distinct_lengths = np.unique(lengths)
    if len(distinct_lengths) * _FEW_ROWS_PER_LENGTH > len(lengths):
        return _with_data(block, *_gather_words(block))
    starts = np.empty(len(block), np.int64)
    copies: list[Bytes] = []
    end = 0
    for length in distinct_lengths.tolist():
        rows = np.flatnonzero(lengths == length)
        starts[rows] = end + np.arange(len(rows), dtype=np.int64) * length
        copies.append(fixed_slices(block.data, block.starts[rows], length).reshape(-1))
        end += len(rows) * length
    return _with_data(block, np.concatenate(copies), starts)


def _is_in_time_range(block: MessageBlock, request: ReadRequest) -> bool:
    if not len(block):
        return True
    first, last = int(block.log_times.min()), int(block.log_times.max())
    return max(request.start_ns, 0) <= first and last < request.end_ns


def _in_time_range(
    block: MessageBlock, request: ReadRequest, unreadable: list[UnreadableRange]
) -> MessageBlock:
    """Return the messages within the requested range; report log times beyond 2262 as unreadable."""
    if _is_in_time_range(block, request):
        return block
    times = block.log_times
    overflowed = times < 0  # the file stores unsigned integers
    if bool(overflowed.any()):
        offset = int(block.offsets[int(overflowed.argmax())])
        reason = f"log time {int(times.view(np.uint64).max())} ns is after the year 2262"
        unreadable.append(
            UnreadableRange(offset, reason, connection=block.connection, count=int(overflowed.sum()))
        )
    selected = ~overflowed & (times >= request.start_ns)
    if request.end_ns <= LATEST_NS:
        selected &= times < request.end_ns
    return block.rows(selected)


def _with_data(block: MessageBlock, data: Bytes, starts: Int64s) -> MessageBlock:
    times, lengths, offsets = map(_without_base, (block.log_times, block.lengths, block.offsets))
    publish_times = None if block.publish_times is None else _without_base(block.publish_times)
    sequences = None if block.sequences is None else _without_base(block.sequences)
    return MessageBlock(block.connection, times, data, starts, lengths, offsets, publish_times, sequences)


def _without_base(values: Int64s) -> Int64s:
    """Copy a view: it would keep its base array alive while messages of a rare topic wait to fill a block."""
    return values if values.base is None else values.copy()


def _gather_words(block: MessageBlock) -> tuple[Bytes, Int64s]:
    """Return the payloads one after the other, each padded to whole words, and the start of each."""
    data, size = block.data, _word_bytes(block)
    words = -(-block.lengths // size)
    ends = np.cumsum(words)
    starts = (ends - words) * size
    index = np.repeat(block.starts - starts, words)
    index += np.arange(0, len(index) * size, size)
    last = len(data) - size
    index[index > last] = 0  # words that reach beyond the buffer; the loop below copies their payloads
    packed = np.ndarray(last + 1, f"V{size}", data, strides=1)[index].view(np.uint8)
    for row in np.flatnonzero(block.starts + words * size > len(data)).tolist():
        start, length = int(block.starts[row]), int(block.lengths[row])
        packed[starts[row] : starts[row] + length] = data[start : start + length]
    return packed, starts


def _word_bytes(block: MessageBlock) -> int:
    """Return a power of two such that an average payload has four to eight words; 1 for a tiny buffer."""
    if len(block.data) < _MAX_WORD_BYTES:
        return 1
    average = block.payload_bytes // len(block)
    return min(max(1 << max(average.bit_length() - 3, 0), _MIN_WORD_BYTES), _MAX_WORD_BYTES)
