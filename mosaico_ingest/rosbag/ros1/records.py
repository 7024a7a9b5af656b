"""This file takes the records of a ROS 1 bag apart, one by one: headers, connections, indexes, chunks."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Protocol

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.errors import BagError

__all__ = [
    "ENTRY",
    "ChunkHead",
    "Connection",
    "Message",
    "Op",
    "Record",
    "chunk_head",
    "connection_of",
    "index_entries",
    "messages_in",
    "number",
    "record_at",
    "records_in",
    "time_of",
    "times_of",
]

_HEADER_LIMIT = 16 << 20
ENTRY = np.dtype([("sec", "<u4"), ("nsec", "<u4"), ("offset", "<u4")])
"""One entry of an index record: when, and where in the chunk's data."""
Header = Mapping[bytes, bytes]


class Op:
    """The kinds of records, as the bag format numbers them."""

    MESSAGE, BAG, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7


class Record(Struct, frozen=True):
    """Where a record's data are, and what its header says."""

    op: int
    header: Header
    at: int
    begin: int
    end: int


class Message(Struct, frozen=True):
    """A message record as the slow way finds it."""

    connection: int
    time_ns: int
    at: int
    begin: int
    end: int


class Connection(Struct, frozen=True):
    """A connection as the file describes it."""

    topic: str
    msgtype: str
    definition: str
    attributes: dict[str, str]


class ChunkHead(Struct, frozen=True):
    """A chunk's own fields; `begin` and `end` bound its data within the bytes it was read from."""

    compression: str
    size: int
    begin: int
    end: int


class Peeking(Protocol):
    """Anything that can be looked at by position."""

    def peek(self, offset: int, size: int) -> bytes:
        """Return up to `size` bytes, fewer at the end."""
        ...


def number(header: Header, name: bytes, size: int) -> int:
    """Return a little-endian number of a record's header.

    Raises:
        BagError: It is missing or of another size.
    """
    value = header.get(name)
    if value is None or len(value) != size:
        raise BagError(f"a record without {name.decode()}, or with one that has not {size} bytes")
    return int.from_bytes(value, "little")


def time_of(header: Header, name: bytes) -> int:
    """Return a time of a record's header, ns since the epoch."""
    both = number(header, name, 8)
    return (both & 0xFFFFFFFF) * 1_000_000_000 + (both >> 32)


def times_of(entries: NDArray[np.void]) -> NDArray[np.int64]:
    """Return the times of index entries, ns since the epoch."""
    return entries["sec"].astype(np.int64) * 1_000_000_000 + entries["nsec"]


def header_of(data: bytes) -> dict[bytes, bytes]:
    """Return a record header's fields.

    Raises:
        BagError: They do not fit.
    """
    found: dict[bytes, bytes] = {}
    at = 0
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        entry = data[at + 4 : at + 4 + size]
        name, equals, value = entry.partition(b"=")
        if at + 4 + size > len(data) or not equals:
            raise BagError("a record header whose fields do not fit")
        found[name] = value
        at += 4 + size
    return found


def record_at(window: Peeking, at: int, stop: int) -> Record:
    """Return the record that begins at `at`.

    Raises:
        BagError: No whole record is there.
    """
    size = _length(window, at, stop)
    if size > _HEADER_LIMIT:
        raise BagError(f"a record header of {size} bytes at {at}")
    header = header_of(window.peek(at + 4, size))
    begin = at + 4 + size + 4
    end = begin + _length(window, begin - 4, stop)
    return Record(number(header, b"op", 1), header, at, begin, end)


def _length(window: Peeking, at: int, stop: int) -> int:
    data = window.peek(at, 4)
    size = int.from_bytes(data, "little")
    if len(data) < 4 or at + 4 + size > stop:  # noqa: PLR2004 - a length word
        raise BagError(f"a record of {size} bytes at {at} where {max(stop - at, 0)} are left")
    return size


class _Memory:
    """Bytes that are looked at as a file is."""

    def __init__(self, data: bytes | memoryview) -> None:
        self._data = memoryview(data)

    def peek(self, offset: int, size: int) -> bytes:
        return bytes(self._data[offset : offset + size])


def records_in(data: bytes | memoryview) -> Iterator[Record]:
    """Yield the records in some bytes.

    Raises:
        BagError: One does not fit.
    """
    memory = _Memory(data)
    at = 0
    while at < len(data):
        record = record_at(memory, at, len(data))
        yield record
        at = record.end


def messages_in(
    data: bytes | memoryview, connections: dict[int, Connection] | None = None
) -> Iterator[Message]:
    """Yield the messages in a chunk's data, and add the connections that are described between them.

    Raises:
        BagError: A record does not fit.
    """
    for record in records_in(data):
        if record.op == Op.MESSAGE:
            key, time_ns = number(record.header, b"conn", 4), time_of(record.header, b"time")
            yield Message(key, time_ns, record.at, record.begin, record.end)
        elif record.op == Op.CONNECTION and connections is not None:
            key = number(record.header, b"conn", 4)
            connections.setdefault(key, connection_of(record, bytes(data[record.begin : record.end])))


def connection_of(record: Record, data: bytes) -> Connection:
    """Return what a connection record says."""
    about = {name: value.decode("utf-8", "replace") for name, value in header_of(data).items()}
    topic = record.header.get(b"topic", b"").decode("utf-8", "replace")
    attributes = {
        name.decode("ascii", "replace"): value
        for name, value in about.items()
        if name in (b"callerid", b"md5sum", b"latching")
    }
    return Connection(
        re.sub("/+", "/", topic), about.get(b"type", ""), about.get(b"message_definition", ""), attributes
    )


def index_entries(record: Record, data: bytes | memoryview) -> tuple[int, NDArray[np.void]]:
    """Return an index record's connection and entries.

    Raises:
        BagError: It is of another version, or its size does not fit its count.
    """
    if number(record.header, b"ver", 4) != 1:
        raise BagError("an index record of another version than 1")
    count = number(record.header, b"count", 4)
    if count * ENTRY.itemsize != record.end - record.begin:
        raise BagError(f"an index record of {record.end - record.begin} bytes for {count} messages")
    return number(record.header, b"conn", 4), np.frombuffer(data[record.begin : record.end], ENTRY)


def chunk_head(raw: bytes | memoryview) -> ChunkHead:
    """Return the fields of the chunk record that `raw` begins with; its data may be cut off.

    Raises:
        BagError: It is no chunk record.
    """
    size = _length(_Memory(raw), 0, len(raw) - 4)
    header = header_of(bytes(raw[4 : 4 + size]))
    if number(header, b"op", 1) != Op.CHUNK:
        raise BagError("no chunk record")
    begin = 4 + size + 4
    compression = header.get(b"compression", b"none").decode("ascii", "replace")
    return ChunkHead(
        compression,
        number(header, b"size", 4),
        begin,
        begin + int.from_bytes(raw[begin - 4 : begin], "little"),
    )
