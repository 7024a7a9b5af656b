"""The records of a ROS 1 bag: headers, connections, indexes, chunks."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator, Mapping
from typing import Protocol

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.source import Source, Window, find_record

_MAX_HEADER_BYTES = 1 << 20
INDEX_ENTRY = np.dtype([("sec", "<u4"), ("nsec", "<u4"), ("offset", "<u4")])
"""One entry of an index record: log time, and offset in the chunk's data."""
Header = Mapping[bytes, bytes]


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


class _Kind(Struct, frozen=True):
    """The features by which a kind of ROS 1 record is recognized."""

    op: int
    fields: frozenset[bytes]
    max_before: int
    """Maximum distance from the start of the header to its field `op=`, in bytes."""


_CHUNK = _Kind(Op.CHUNK, frozenset({b"compression", b"size"}), 128)
_MESSAGE = _Kind(Op.MESSAGE, frozenset({b"topic", b"type", b"md5", b"sec", b"nsec"}), 512)


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
