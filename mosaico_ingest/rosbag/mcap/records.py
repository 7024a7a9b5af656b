"""This file takes the records of an MCAP file apart, kinds, schemas, channels, chunk heads, and spells new ones."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping

from msgspec import Struct

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.source import Fields

__all__ = [
    "RECORD",
    "ChunkHead",
    "McapChannel",
    "Op",
    "Schema",
    "channel_of",
    "chunk_head",
    "record_bytes",
    "records_in",
    "schema_of",
    "text_bytes",
    "texts_bytes",
]

RECORD = struct.Struct("<BQ")
"""Every record begins with its kind and the number of bytes that follow."""


class Op:
    """The kinds of records that matter here, as the MCAP specification numbers them."""

    HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
    STATISTICS = 0x0B
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F


class Schema(Struct, frozen=True):
    """A message type as the file describes it."""

    name: str
    encoding: str
    text: str


class McapChannel(Struct, frozen=True):
    """A channel as the file describes it."""

    schema: int
    topic: str
    encoding: str
    metadata: dict[str, str]


class ChunkHead(Struct, frozen=True):
    """A chunk's own fields; `begin` and `end` bound its data within the bytes it was read from."""

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    begin: int
    end: int


def schema_of(fields: Fields) -> tuple[int, Schema]:
    """Return a schema record's id and content."""
    return fields.u16(), Schema(fields.text(), fields.text(), fields.text())


def channel_of(fields: Fields) -> tuple[int, McapChannel]:
    """Return a channel record's id and content."""
    return fields.u16(), McapChannel(fields.u16(), fields.text(), fields.text(), fields.texts())


def chunk_head(data: bytes | memoryview, at: int = RECORD.size) -> ChunkHead:
    """Return a chunk's fields from the bytes of its record; its data may be cut off.

    Raises:
        BagError: The record ends within its fields.
    """
    fields = Fields(data, at)
    start_ns, end_ns, size, crc = fields.u64(), fields.u64(), fields.u64(), fields.u32()
    compression = fields.text()
    length = fields.u64()
    begin = len(data) - fields.left
    return ChunkHead(start_ns, end_ns, size, crc, compression, begin, begin + length)


def records_in(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield kind, begin and end of every record's content.

    Raises:
        BagError: One does not fit.
    """
    at = 0
    while at < len(data):
        if at + RECORD.size > len(data):
            raise BagError(f"{len(data) - at} bytes left where a record must begin")
        op, length = RECORD.unpack_from(data, at)
        at += RECORD.size
        if length > len(data) - at:
            raise BagError(f"a record of {length} bytes with {len(data) - at} left")
        yield op, at, at + length
        at += length


def record_bytes(op: int, content: bytes | bytearray) -> bytes:
    """Return a record of a kind."""
    return RECORD.pack(op, len(content)) + content


def text_bytes(text: str) -> bytes:
    """Return a text behind its length."""
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def texts_bytes(texts: Mapping[str, str]) -> bytes:
    """Return a map of texts behind its length in bytes."""
    data = b"".join(text_bytes(part) for item in texts.items() for part in item)
    return struct.pack("<I", len(data)) + data
