"""The records of an MCAP file: parsing and serialization."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping

import numpy as np
from msgspec import Struct

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.source import Fields, Source, find_record

RECORD = struct.Struct("<BQ")
"""The head of every record: its kind, and the number of bytes that follow."""
_HEAD_BYTES = 256
"""Bytes to read for the head of a chunk record; more than it can take."""


class Op:
    """The kinds of records that this package uses, as numbered in the MCAP specification."""

    HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
    STATISTICS = 0x0B
    METADATA, METADATA_INDEX = 0x0C, 0x0D
    ATTACHMENT, ATTACHMENT_INDEX = 0x09, 0x0A
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F


class SchemaRecord(Struct, frozen=True):
    """A message type."""

    name: str
    encoding: str
    data: bytes


class ChannelRecord(Struct, frozen=True):
    """A channel."""

    schema: int
    topic: str
    encoding: str
    metadata: dict[str, str]


class MetadataRecord(Struct, frozen=True):
    """A metadata record: its name and its entries."""

    name: str
    entries: dict[str, str]


class ChunkHead(Struct, frozen=True):
    """The fields of a chunk record; `start` and `end` bound its data within the bytes that were read."""

    start_ns: int
    end_ns: int
    size: int
    """Decompressed size in bytes."""
    crc: int
    compression: str
    start: int
    end: int


def schema_of(fields: Fields) -> tuple[int, SchemaRecord]:
    """Return the id and content of a schema record."""
    return fields.u16(), SchemaRecord(fields.text(), fields.text(), fields.take(fields.u32()))


def channel_of(fields: Fields) -> tuple[int, ChannelRecord]:
    """Return the id and content of a channel record."""
    return fields.u16(), ChannelRecord(fields.u16(), fields.text(), fields.text(), fields.texts())


def metadata_of(fields: Fields) -> MetadataRecord:
    """Return the content of a metadata record."""
    return MetadataRecord(fields.text(), fields.texts())


def chunk_head(data: bytes | memoryview, start: int = RECORD.size) -> ChunkHead:
    """Return the fields of a chunk record, whose data may be truncated.

    Raises:
        BagError: The record ends before its data.
    """
    fields = Fields(data, start)
    start_ns, end_ns, size, crc = fields.u64(), fields.u64(), fields.u64(), fields.u32()
    compression = fields.text()
    length = fields.u64()
    data_start = len(data) - fields.left
    return ChunkHead(start_ns, end_ns, size, crc, compression, data_start, data_start + length)


def records_in(data: bytes | memoryview) -> Iterator[tuple[int, int, int]]:
    """Yield the kind of each record, and start and end of its content.

    Raises:
        BagError: A record extends beyond the data.
    """
    position = 0
    while position < len(data):
        if position + RECORD.size > len(data):
            raise BagError(f"{len(data) - position} bytes left where a record must start")
        op, length = RECORD.unpack_from(data, position)
        position += RECORD.size
        if length > len(data) - position:
            raise BagError(f"a record of {length} bytes with {len(data) - position} left")
        yield op, position, position + length
        position += length


def find_chunk(source: Source, start: int, stop: int) -> int | None:
    """Return the offset of the next complete chunk between `start` and `stop`, None if there is none."""

    def is_chunk(offset: int) -> bool:
        data = source.read_some(offset, _HEAD_BYTES)
        try:
            head = chunk_head(data)
        except BagError:
            return False
        _, length = RECORD.unpack_from(data)
        end = RECORD.size + length
        return head.end == end and offset + end <= stop and head.compression in {"", "zstd", "lz4"}

    return find_record(source, start, stop, _chunk_candidates, is_chunk)


def record_bytes(op: int, content: bytes | bytearray) -> bytes:
    """Return a serialized record."""
    return RECORD.pack(op, len(content)) + content


def text_bytes(text: str) -> bytes:
    """Return a serialized string: its length in bytes, then UTF-8."""
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def texts_bytes(texts: Mapping[str, str]) -> bytes:
    """Return a serialized map of strings: its length in bytes, then keys and values."""
    data = b"".join(text_bytes(part) for item in texts.items() for part in item)
    return struct.pack("<I", len(data)) + data


def _chunk_candidates(data: bytes) -> Iterator[int]:
    """Yield positions with the kind of a chunk, a length below 2**40 and a short name of the compression."""
    view = np.frombuffer(data, np.uint8)
    count = max(len(view) - 41, 0)
    zeros = [view[position : position + count] == 0 for position in (6, 7, 8, 38, 39, 40)]
    likely = np.logical_and.reduce([view[:count] == Op.CHUNK, view[37 : 37 + count] <= len("zstd"), *zeros])
    yield from np.flatnonzero(likely).tolist()
