"""The records of a ROS 1 bag, and its index: from its index section, or from a walk over its records."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.blocks import UnreadableRange
from mosaico_ingest.rosbag.compression import MAX_CHUNK_BYTES, decompress_partially
from mosaico_ingest.rosbag.source import Source, Window, find_record

_MAX_HEADER_BYTES = 1 << 20
INDEX_ENTRY = np.dtype([("sec", "<u4"), ("nsec", "<u4"), ("offset", "<u4")])
"""One entry of an index record: log time, and offset in the chunk's data."""
Header = Mapping[bytes, bytes]
_VERSION = b"#ROSBAG V2.0\n"
_RUN_BYTES = 4 << 20
"""Maximum size of an extent of messages outside chunks."""


class Op:
    """The kinds of records, as numbered in the bag format."""

    MESSAGE, BAG, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7


class Record(Struct, frozen=True):
    """The header of a record, and the positions of the record and of its data."""

    op: int
    header: Header
    offset: int
    """Position of the record."""
    start: int
    end: int
    """Start and end of the data, which is the end of the record as well."""


class MessageRecord(Struct, frozen=True):
    """A message record; the positions are those of `Record`."""

    connection: int
    time_ns: int
    offset: int
    start: int
    end: int


class ConnectionRecord(Struct, frozen=True):
    """A connection as the file describes it."""

    topic: str
    msgtype: str
    definition: str
    attributes: dict[str, str]


class ChunkHead(Struct, frozen=True):
    """The fields of a chunk record; `start` and `end` bound its data within the bytes that were read."""

    compression: str
    size: int
    """Decompressed size in bytes."""
    start: int
    end: int


class Peekable(Protocol):
    """A source of bytes with random access."""

    def peek(self, offset: int, size: int) -> bytes:
        """Return up to `size` bytes; fewer at the end."""
        ...


class Extent(Struct, frozen=True):
    """A range of the file that is read together: a chunk with its index records, or messages outside chunks."""

    offset: int
    stop: int
    """Offset of the first byte after the extent."""
    start_ns: int
    end_ns: int
    counts: dict[int, int]
    """Messages by connection."""
    is_chunk: bool = True
    is_truncated: bool = False


@dataclass(slots=True)
class Ros1Index:
    """Connections and extents of a file."""

    connections: dict[int, ConnectionRecord] = field(default_factory=dict[int, ConnectionRecord])
    extents: list[Extent] = field(default_factory=list[Extent])
    unreadable: list[UnreadableRange] = field(default_factory=list[UnreadableRange])


def number(header: Header, name: bytes, size: int) -> int:
    """Return a little-endian number of `size` bytes from a header.

    Raises:
        BagError: The field is missing or has another size.
    """
    value = header.get(name)
    if value is None or len(value) != size:
        raise BagError(f"a record without a field {name.decode()} of {size} bytes")
    return int.from_bytes(value, "little")


def time_of(header: Header, name: bytes) -> int:
    """Return a time from a header, nanoseconds since the epoch."""
    both = number(header, name, 8)
    return (both & 0xFFFFFFFF) * 1_000_000_000 + (both >> 32)


def times_of(entries: NDArray[np.void]) -> NDArray[np.int64]:
    """Return the log times of index entries, nanoseconds since the epoch."""
    return entries["sec"].astype(np.int64) * 1_000_000_000 + entries["nsec"]


def header_of(data: bytes) -> dict[bytes, bytes]:
    """Return the fields of a record header.

    Raises:
        BagError: A field extends beyond the header.
    """
    fields: dict[bytes, bytes] = {}
    position = 0
    while position < len(data):
        size = int.from_bytes(data[position : position + 4], "little")
        entry = data[position + 4 : position + 4 + size]
        name, equals, value = entry.partition(b"=")
        if position + 4 + size > len(data) or not equals:
            raise BagError("a record header with invalid fields")
        fields[name] = value
        position += 4 + size
    return fields


def record_at(window: Peekable, offset: int, stop: int) -> Record:
    """Return the record at `offset`.

    Raises:
        BagError: There is no complete record before `stop`.
    """
    size = _length(window, offset, stop)
    if size > _MAX_HEADER_BYTES:
        raise BagError(f"a record header of {size} bytes at {offset}")
    header = header_of(window.peek(offset + 4, size))
    start = offset + 4 + size + 4
    end = start + _length(window, start - 4, stop)
    return Record(number(header, b"op", 1), header, offset, start, end)


def records_in(data: bytes | memoryview) -> Iterator[Record]:
    """Yield the records in some bytes.

    Raises:
        BagError: A record is invalid.
    """
    memory = _Memory(data)
    offset = 0
    while offset < len(data):
        record = record_at(memory, offset, len(data))
        yield record
        offset = record.end


def messages_in(
    data: bytes | memoryview, connections: dict[int, ConnectionRecord] | None = None
) -> Iterator[MessageRecord]:
    """Yield the messages in a chunk's data, and add the connection records between them to `connections`.

    Raises:
        BagError: A record is invalid.
    """
    for record in records_in(data):
        if record.op == Op.MESSAGE:
            key, time_ns = number(record.header, b"conn", 4), time_of(record.header, b"time")
            yield MessageRecord(key, time_ns, record.offset, record.start, record.end)
        elif record.op == Op.CONNECTION and connections is not None:
            key = number(record.header, b"conn", 4)
            connections.setdefault(key, connection_of(record, bytes(data[record.start : record.end])))


def connection_of(record: Record, data: bytes) -> ConnectionRecord:
    """Return the content of a connection record."""
    fields = {name: value.decode("utf-8", "replace") for name, value in header_of(data).items()}
    topic = record.header.get(b"topic", b"").decode("utf-8", "replace")
    attributes = {
        name.decode("ascii", "replace"): value
        for name, value in fields.items()
        if name in (b"callerid", b"md5sum", b"latching")
    }
    return ConnectionRecord(
        re.sub("/+", "/", topic), fields.get(b"type", ""), fields.get(b"message_definition", ""), attributes
    )


def index_entries(record: Record, data: bytes | memoryview) -> tuple[int, NDArray[np.void]]:
    """Return the connection and the entries of an index record.

    Raises:
        BagError: The record has another version, or its size does not match its count.
    """
    if number(record.header, b"ver", 4) != 1:
        raise BagError("an index record of another version than 1")
    count = number(record.header, b"count", 4)
    if count * INDEX_ENTRY.itemsize != record.end - record.start:
        raise BagError(f"an index record of {record.end - record.start} bytes for {count} messages")
    return number(record.header, b"conn", 4), np.frombuffer(data[record.start : record.end], INDEX_ENTRY)


def chunk_head(raw: bytes | memoryview) -> ChunkHead:
    """Return the fields of the chunk record at the start of `raw`; its data may be truncated.

    Raises:
        BagError: It is not a chunk record.
    """
    size = _length(_Memory(raw), 0, len(raw) - 4)
    header = header_of(bytes(raw[4 : 4 + size]))
    if number(header, b"op", 1) != Op.CHUNK:
        raise BagError("no chunk record")
    start = 4 + size + 4
    compression = header.get(b"compression", b"none").decode("ascii", "replace")
    end = start + int.from_bytes(raw[start - 4 : start], "little")
    return ChunkHead(compression, number(header, b"size", 4), start, end)


def find_chunk(source: Source, start: int, stop: int) -> int | None:
    """Return the offset of the next complete chunk of a ROS 1 bag, None if there is none."""
    return find_record(source, start, stop, _candidates(_CHUNK), _is_kind(source, stop, _CHUNK))


def find_message(source: Source, start: int, stop: int) -> int | None:
    """Return the offset of the next complete message of a bag of version 1.2, None if there is none."""
    return find_record(source, start, stop, _candidates(_MESSAGE), _is_kind(source, stop, _MESSAGE))


def read_index(source: Source, max_chunk_bytes: int = MAX_CHUNK_BYTES) -> Ros1Index:
    """Return the index from the index section, or from a walk if the section is missing or damaged.

    Raises:
        BagError: The bag is encrypted, has an unsupported version, or lacks a complete first record.
    """
    window = Window(source)
    line = window.peek(0, len(_VERSION))
    if line != _VERSION:
        version = re.split(rb"[\r\n]", window.peek(0, 32))[0].decode("ascii", "replace")
        raise BagError(
            f"unsupported bag format {version!r}; V2.0 and V1.2 are supported",
            where=str(source.path),
            hint="convert it with `rosbag fix`",
        )
    head = record_at(window, len(_VERSION), source.size)
    if head.op != Op.BAG:
        raise BagError(f"a record of kind {head.op} instead of the bag header", where=str(source.path))
    if head.header.get(b"encryptor"):
        name = head.header[b"encryptor"].decode("ascii", "replace")
        raise BagError(
            f"the bag is encrypted with {name!r}", where=str(source.path), hint="decrypt it with rosbag"
        )
    index_at = number(head.header, b"index_pos", 8)
    problem = "the bag was not closed and has no index"
    if index_at:
        source.prefetch([(index_at, source.size)])
        try:
            return _read_index_section(source, window, head, index_at)
        except BagError as err:
            problem = f"its index is damaged ({err.what})"
    index = Ros1Index()
    reason = f"{problem}; the file was read record by record"
    index.unreadable.append(UnreadableRange(len(_VERSION), reason, count=0))
    source.fetch_whole()
    _Walk(source, index, max_chunk_bytes).over(head.end, source.size)
    return index


class _Kind(Struct, frozen=True):
    """The features by which a kind of ROS 1 record is recognized."""

    op: int
    fields: frozenset[bytes]
    max_before: int
    """Maximum distance from the start of the header to its field `op=`, in bytes."""


_CHUNK = _Kind(Op.CHUNK, frozenset({b"compression", b"size"}), 128)


_MESSAGE = _Kind(Op.MESSAGE, frozenset({b"topic", b"type", b"md5", b"sec", b"nsec"}), 512)


def _length(window: Peekable, offset: int, stop: int) -> int:
    data = window.peek(offset, 4)
    size = int.from_bytes(data, "little")
    if len(data) < 4 or offset + 4 + size > stop:  # noqa: PLR2004 - a length word
        raise BagError(f"a record of {size} bytes at {offset} where {max(stop - offset, 0)} are left")
    return size


class _Memory:
    """Bytes in memory as a `Peekable`."""

    def __init__(self, data: bytes | memoryview) -> None:
        self._data = memoryview(data)

    def peek(self, offset: int, size: int) -> bytes:
        return bytes(self._data[offset : offset + size])


def _is_kind(source: Source, stop: int, kind: _Kind) -> Callable[[int], bool]:
    """Return a predicate: whether a complete record of the kind starts at an offset."""
    window = Window(source)

    def is_record(offset: int) -> bool:
        try:
            record = record_at(window, offset, stop)
        except BagError:
            return False
        return record.op == kind.op and kind.fields <= record.header.keys()

    return is_record


def _candidates(kind: _Kind) -> Callable[[bytes], Iterator[int]]:
    """Return a function that yields the positions of record headers that contain the field `op=` of the kind."""
    field = re.compile(re.escape(b"\x04\x00\x00\x00op=" + bytes([kind.op])))

    def candidates(data: bytes) -> Iterator[int]:
        next_start = 0
        for match in field.finditer(data):
            for start in range(max(match.start() - kind.max_before, next_start), match.start() - 3):
                (size,) = struct.unpack_from("<I", data, start)
                if match.end() - start - 4 <= size <= 2 * kind.max_before:
                    yield start
            next_start = max(match.start() - 3, next_start)

    return candidates


def _read_index_section(source: Source, window: Window, head: Record, index_at: int) -> Ros1Index:
    index = Ros1Index()
    chunks: list[tuple[int, int, int, dict[int, int]]] = []
    position = index_at
    expected = number(head.header, b"conn_count", 4), number(head.header, b"chunk_count", 4)
    while position < source.size and (len(index.connections), len(chunks)) != expected:
        record = record_at(window, position, source.size)
        data = window.peek(record.start, record.end - record.start)
        if record.op == Op.CONNECTION:
            index.connections[number(record.header, b"conn", 4)] = connection_of(record, data)
        elif record.op == Op.CHUNK_INFO:
            chunks.append(_chunk_info(record, data, index_at))
        position = record.end
    if (len(index.connections), len(chunks)) != expected:
        contents = f"{len(index.connections)} connections and {len(chunks)} chunks"
        raise BagError(f"{expected[0]} connections and {expected[1]} chunks announced, {contents} listed")
    starts = sorted(chunk[0] for chunk in chunks)
    stops = dict(zip(starts, [*starts[1:], index_at], strict=False))
    if any(key not in index.connections for chunk in chunks for key in chunk[3]):
        raise BagError("messages of a connection that is not described")
    index.extents = [
        Extent(offset, stops[offset], first, last, counts) for offset, first, last, counts in chunks
    ]
    return index


def _chunk_info(record: Record, data: bytes, index_at: int) -> tuple[int, int, int, dict[int, int]]:
    """Return offset, first and last log time, and messages by connection of a chunk."""
    offset = number(record.header, b"chunk_pos", 8)
    pairs = np.frombuffer(data[: len(data) // 8 * 8], "<u4").reshape(-1, 2).tolist()
    if (
        number(record.header, b"ver", 4) != 1
        or number(record.header, b"count", 4) != len(pairs)
        or offset >= index_at
    ):
        raise BagError(f"an invalid chunk info record for the chunk at {offset}")
    counts = {int(key): int(count) for key, count in pairs}
    return offset, time_of(record.header, b"start_time"), time_of(record.header, b"end_time"), counts


class _Walk:
    """Visits record after record and adds it to an index."""

    def __init__(self, source: Source, index: Ros1Index, max_chunk_bytes: int) -> None:
        self._source = source
        self._window = Window(source)
        self._index = index
        self._max_chunk_bytes = max_chunk_bytes

    def over(self, start: int, stop: int) -> None:
        """Visit every record from `start` to `stop`; after an invalid record, continue with the next chunk."""
        position = start
        while position < stop:
            try:
                record = record_at(self._window, position, stop)
            except BagError as err:
                next_chunk = find_chunk(self._source, position + 1, stop)
                resume_at = stop if next_chunk is None else next_chunk
                self._recount_last_chunk(position)
                self._add_invalid(position, resume_at, err.what)
                position = resume_at
                continue
            try:
                self._add_record(record)
            except BagError as err:
                self._add_unreadable(position, f"a damaged record of kind {record.op}: {err.what}")
            position = record.end
        self._recount_last_chunk(position)

    def _recount_last_chunk(self, position: int) -> None:
        """Count the messages of the chunk before `position`: where a file is truncated, index records may be missing."""
        extents = self._index.extents
        if extents and extents[-1].is_chunk and extents[-1].stop == position:
            extents[-1] = self._counted(extents[-1])

    def _add_record(self, record: Record) -> None:
        extents = self._index.extents
        if record.op == Op.CHUNK:
            extents.append(Extent(record.offset, record.end, 0, 0, {}))
            if self._window.peek(record.end, 4 + 47).find(b"op=\x04") < 0:
                extents[-1] = self._counted(extents[-1])
        elif record.op == Op.INDEX and extents and extents[-1].stop == record.offset:
            extents[-1] = self._with_index(extents[-1], record)
        elif record.op == Op.CONNECTION:
            key = number(record.header, b"conn", 4)
            data = self._source.read(record.start, record.end - record.start)
            self._index.connections.setdefault(key, connection_of(record, data))
        elif record.op == Op.MESSAGE:
            key, time_ns = number(record.header, b"conn", 4), time_of(record.header, b"time")
            self._add_message(record, key, time_ns)

    def _add_message(self, record: Record, key: int, time_ns: int) -> None:
        """Add a message outside chunks to the run of messages that precedes it, or start a new run."""
        extents = self._index.extents
        run = extents[-1] if extents else None
        if run is None or run.is_chunk or run.stop != record.offset or record.end - run.offset > _RUN_BYTES:
            extents.append(Extent(record.offset, record.end, time_ns, time_ns, {key: 1}, is_chunk=False))
            return
        run.counts[key] = run.counts.get(key, 0) + 1
        first, last = min(run.start_ns, time_ns), max(run.end_ns, time_ns)
        extents[-1] = replace(run, stop=record.end, start_ns=first, end_ns=last)

    def _with_index(self, extent: Extent, record: Record) -> Extent:
        """Return the chunk's extent with one more index record.

        If the index record names an undescribed connection, its description is inside the chunk.
        """
        data = self._source.read(record.start, record.end - record.start)
        key, entries = index_entries(Record(record.op, record.header, 0, 0, len(data)), data)
        if key not in self._index.connections:
            self._counted(extent)
        times = times_of(entries)
        if not len(times):
            return replace(extent, stop=record.end)
        first, last = int(times.min()), int(times.max())
        if extent.counts:
            first, last = min(first, extent.start_ns), max(last, extent.end_ns)
        counts = {**extent.counts, key: len(times)}
        return replace(extent, stop=record.end, start_ns=first, end_ns=last, counts=counts)

    def _counted(self, extent: Extent) -> Extent:
        """Return the chunk's extent with times and counts from its readable messages, and add its connections.

        A truncated chunk, and a chunk without readable messages, becomes an unreadable range.
        """
        counts: dict[int, int] = {}
        first, last = 0, 0
        raw = self._source.read(extent.offset, extent.stop - extent.offset)
        try:
            head = chunk_head(raw)
            compressed = memoryview(raw)[head.start : head.end]
            data = decompress_partially(compressed, head.compression, head.size, limit=self._max_chunk_bytes)
            if extent.is_truncated:
                size = f"{len(data)} of its {head.size} bytes"
                self._add_unreadable(extent.offset, f"the chunk is truncated; {size} could be read")
            for message in messages_in(data.data, self._index.connections):
                first = min(first, message.time_ns) if counts else message.time_ns
                last = max(last, message.time_ns)
                counts[message.connection] = counts.get(message.connection, 0) + 1
        except BagError as err:
            # The reader reports the damage of chunks with messages when it reads them.
            if not counts and not extent.is_truncated:
                self._add_unreadable(extent.offset, f"broken chunk: {err.what}")
        return replace(extent, start_ns=first, end_ns=last, counts=counts)

    def _add_invalid(self, start: int, stop: int, reason: str) -> None:
        extent = self._counted(Extent(start, stop, 0, 0, {}, is_truncated=True))
        if extent.counts:
            self._index.extents.append(extent)
        else:
            self._add_unreadable(start, f"{reason}; {stop - start} bytes are not read")

    def _add_unreadable(self, offset: int, reason: str) -> None:
        unreadable = UnreadableRange(offset, reason)
        if unreadable not in self._index.unreadable:
            self._index.unreadable.append(unreadable)
