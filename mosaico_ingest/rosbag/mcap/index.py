"""The records of an MCAP file, and its index: from its summary, or from a walk over its records."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import partial
from typing import TypeVar

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace

from mosaico_ingest.containers import MCAP
from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.blocks import LATEST_NS, Attachment, UnreadableRange
from mosaico_ingest.rosbag.compression import MAX_CHUNK_BYTES, decompress_partially
from mosaico_ingest.rosbag.source import Fields, Source, Window, find_record

RECORD = struct.Struct("<BQ")
"""The head of every record: its kind, and the number of bytes that follow."""
_HEAD_BYTES = 256
"""Bytes to read for the head of a chunk record; more than it can take."""
T = TypeVar("T")
_FOOTER_BYTES = RECORD.size + 20
_INDEX_ENTRY_BYTES = 16
_CHUNK_HEAD_BYTES = 1 << 12
"""Bytes to read for the fields of a chunk record before its data; more than they can take."""
_RUN_BYTES = 4 << 20
"""Maximum size of an extent of messages outside chunks."""
_ATTACHMENT_HEAD_BYTES = 1 << 16
"""Bytes to read for the fields of an attachment before its data."""
_ATTACHMENT_BYTES = 4 << 20
"""Bytes of an attachment that are read at a time."""
_MESSAGE = struct.Struct("<HIQ")


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


class Extent(Struct, frozen=True):
    """A range of the file that is read together: a chunk with its message indexes, or messages outside chunks."""

    offset: int
    stop: int
    """Offset of the first byte after the extent."""
    start_ns: int
    end_ns: int
    indexes: bytes = b""
    """Channel (u16) and file offset (u64) of each message index; empty if there are none."""
    size: int = 0
    """Decompressed size of the chunk according to its index, in bytes; 0 if unknown."""
    is_chunk: bool = True
    is_truncated: bool = False

    def has_any(self, channels: Collection[int]) -> bool:
        """Return whether the extent may have messages of one of the channels."""
        return not self.indexes or any(key in channels for key, _ in self.index_offsets())

    def index_offsets(self) -> list[tuple[int, int]]:
        """Return channel and file offset of each message index."""
        return list(struct.iter_unpack("<HQ", self.indexes))


class McapIndex(Struct):
    """Schemas, channels and extents of a file."""

    schemas: dict[int, SchemaRecord] = field(default_factory=dict[int, SchemaRecord])
    channels: dict[int, ChannelRecord] = field(default_factory=dict[int, ChannelRecord])
    extents: list[Extent] = field(default_factory=list[Extent])
    counts: dict[int, int] | None = None
    """Messages by channel; None if neither the summary nor a walk could determine them."""
    start_ns: int | None = None
    end_ns: int | None = None
    data_end: int = 0
    """Offset of the summary, or of the first byte that cannot be read."""
    unreadable: list[UnreadableRange] = field(default_factory=list[UnreadableRange])
    metadata: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])
    """Start and end of the content of each metadata record."""
    attachments: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])
    """Start and end of the content of each attachment record."""
    lists_kept_records: bool = True
    """Whether `metadata` and `attachments` are complete; the summary may omit the indexes of these records."""
    is_walked: bool = False
    """Whether the index comes from a walk over all records rather than from the summary."""


class KeptRecords(Struct, frozen=True):
    """The records of a file that a sequence keeps besides messages."""

    metadata: tuple[MetadataRecord, ...]
    attachments: tuple[Attachment, ...]
    damaged: tuple[str, ...]
    """One line for each record that cannot be read."""


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


def read_index(source: Source, max_chunk_bytes: int = MAX_CHUNK_BYTES) -> McapIndex:
    """Return the index from the summary, or from a walk if the summary is missing, incomplete or damaged."""
    problem = None
    try:
        index = _read_summary(source)
    except BagError as err:
        index, problem = None, str(err)
    if index is not None:
        return index
    index = McapIndex(data_end=source.size)
    if problem:
        reason = f"{problem}; the file was read record by record"
        index.unreadable.append(UnreadableRange(source.size, reason, count=0))
    source.fetch_whole()
    walk = _Walk(source, index, max_chunk_bytes)
    walk.over(len(MCAP), source.size)
    walk.report_undescribed_chunks()
    return index


def read_extents(
    source: Source, index: McapIndex, max_chunk_bytes: int = MAX_CHUNK_BYTES
) -> tuple[list[Extent], list[UnreadableRange]]:
    """Return all extents by time, also extents that the summary lacks, and damage between chunks."""
    index_extents = sorted(index.extents, key=lambda extent: extent.offset)
    unlisted = McapIndex()
    position = len(MCAP)
    if not index.is_walked:
        walk = _Walk(source, unlisted, max_chunk_bytes)
        for extent in index_extents:
            if extent.offset > position:
                walk.over(position, extent.offset)
            position = max(position, extent.stop)
        walk.over(position, index.data_end)
    return sorted(index_extents + unlisted.extents, key=lambda extent: extent.start_ns), unlisted.unreadable


def read_kept_records(
    source: Source, index: McapIndex, max_chunk_bytes: int = MAX_CHUNK_BYTES
) -> KeptRecords:
    """Return the metadata records and attachments; walks over all records if the summary does not list them."""
    if not index.lists_kept_records:
        walked = McapIndex()
        _Walk(source, walked, max_chunk_bytes).over(len(MCAP), index.data_end)
        index = walked
    damaged: list[str] = []

    def undamaged(kind: str, ranges: Iterable[tuple[int, int]], read: Callable[[int, int], T]) -> Iterator[T]:
        for start, end in ranges:
            try:
                yield read(start, end)
            except BagError as err:  # noqa: PERF203 - each record may be damaged
                damaged.append(f"the {kind} at {start - RECORD.size} cannot be read: {err.what}")

    metadata = tuple(
        undamaged(
            "metadata record",
            index.metadata,
            lambda start, end: metadata_of(Fields(source.read(start, end - start))),
        )
    )
    attachments = tuple(undamaged("attachment", index.attachments, partial(_attachment, source)))
    return KeptRecords(metadata, attachments, tuple(damaged))


def attachment_chunks(source: Source, attachment: Attachment) -> Iterator[bytes]:
    """Yield the content of an attachment.

    Raises:
        BagError: The content cannot be read, or differs from its checksum; raised after the last chunk.
    """
    end = attachment.data_offset + attachment.size_bytes
    crc = zlib.crc32(source.read(attachment.offset, attachment.data_offset - attachment.offset))
    for position in range(attachment.data_offset, end, _ATTACHMENT_BYTES):
        chunk = source.read(position, min(_ATTACHMENT_BYTES, end - position))
        crc = zlib.crc32(chunk, crc)
        yield chunk
    expected = int.from_bytes(source.read(end, 4), "little")
    if expected and crc != expected:
        raise BagError(f"the checksum of the attachment {attachment.name!r} differs from the one in the file")


def _chunk_candidates(data: bytes) -> Iterator[int]:
    """Yield positions with the kind of a chunk, a length below 2**40 and a short name of the compression."""
    view = np.frombuffer(data, np.uint8)
    count = max(len(view) - 41, 0)
    zeros = [view[position : position + count] == 0 for position in (6, 7, 8, 38, 39, 40)]
    likely = np.logical_and.reduce([view[:count] == Op.CHUNK, view[37 : 37 + count] <= len("zstd"), *zeros])
    yield from np.flatnonzero(likely).tolist()


def _attachment(source: Source, start: int, end: int) -> Attachment:
    head = source.read(start, min(end - start, _ATTACHMENT_HEAD_BYTES))
    fields = Fields(head)
    log_ns, create_ns, name, media_type = fields.u64(), fields.u64(), fields.text(), fields.text()
    size = fields.u64()
    data = start + len(head) - fields.left
    if data + size + 4 != end:
        raise BagError(f"the attachment {name!r} has {size} bytes, which do not fit its record")
    has_crc = source.read(end - 4, 4) != bytes(4)
    return Attachment(name, media_type, log_ns, create_ns, size, has_crc, offset=start, data_offset=data)


def _read_summary(source: Source) -> McapIndex | None:
    tail_at = source.size - _FOOTER_BYTES - len(MCAP)
    if tail_at < len(MCAP):
        raise BagError("the file ends without a footer")
    tail = source.read(tail_at, _FOOTER_BYTES + len(MCAP))
    if tail[0] != Op.FOOTER or tail[-len(MCAP) :] != MCAP:
        raise BagError("the file ends without a footer")
    start, _, crc = struct.unpack_from("<QQI", tail, RECORD.size)
    if not start:
        return None
    if not len(MCAP) <= start <= tail_at:
        raise BagError(f"the footer puts the summary at {start}, outside the file")
    data = source.read(start, tail_at - start)
    if crc and zlib.crc32(tail[: RECORD.size + 16], zlib.crc32(data)) != crc:
        raise BagError("the checksum of the summary differs from that in the footer")
    return _parse_summary(data, start)


def _parse_summary(data: bytes, data_end: int) -> McapIndex | None:
    """Return the content of the summary, or None if records that the reader needs are missing."""
    index = McapIndex(data_end=data_end)
    chunk_count: int | None = None
    metadata_count = attachment_count = 0
    for op, start, end in records_in(data):
        fields = Fields(data, start, end)
        if op == Op.CHUNK_INDEX:
            index.extents.append(_indexed_chunk(fields, data_end))
        elif op == Op.METADATA_INDEX:
            offset, length = fields.u64(), fields.u64()
            index.metadata.append((offset + RECORD.size, offset + length))
        elif op == Op.STATISTICS:
            chunk_count, metadata_count, attachment_count = _add_statistics(fields, index)
        elif op == Op.ATTACHMENT_INDEX:
            offset, length = fields.u64(), fields.u64()
            index.attachments.append((offset + RECORD.size, offset + length))
        else:
            _add_description(op, fields, index)
    counts = index.counts
    if counts is None or chunk_count != len(index.extents) or not index.channels.keys() >= counts.keys():
        return None
    index.lists_kept_records = (metadata_count, attachment_count) == (
        len(index.metadata),
        len(index.attachments),
    )
    return index


def _add_description(op: int, fields: Fields, index: McapIndex) -> None:
    """Add a schema or channel record to the index; ignore others."""
    if op == Op.SCHEMA:
        key, schema = schema_of(fields)
        index.schemas[key] = schema
    elif op == Op.CHANNEL:
        key, channel = channel_of(fields)
        index.channels[key] = channel


def _indexed_chunk(fields: Fields, data_end: int) -> Extent:
    start_ns, end_ns, offset, length = fields.u64(), fields.u64(), fields.u64(), fields.u64()
    indexes = fields.take(fields.u32())
    stop = offset + length + fields.u64()
    if stop > data_end or len(indexes) % 10:
        raise BagError(f"the chunk index at {offset} does not fit the file")
    fields.take(fields.u32() + 8)  # compression and compressed size, which the chunk record has too
    return Extent(offset, stop, start_ns, end_ns, indexes, fields.u64())


def _add_statistics(fields: Fields, index: McapIndex) -> tuple[int, int, int]:
    """Add counts and times to the index; return the number of chunks, of metadata records and of attachments."""
    total = fields.u64()
    fields.take(2 + 4)
    attachments, metadata, chunks = fields.u32(), fields.u32(), fields.u32()
    start_ns, end_ns = fields.u64(), fields.u64()
    index.counts = {channel: count for channel, count in fields.pairs("<HQ") if count}
    if max(start_ns, end_ns) > LATEST_NS:
        raise BagError(f"messages from {start_ns} to {end_ns} ns, which is after the year 2262")
    if total != sum(index.counts.values()):
        raise BagError(f"{total} messages in total, {sum(index.counts.values())} by channel")
    if total:
        index.start_ns, index.end_ns = start_ns, end_ns
    return chunks, metadata, attachments


class _Walk:
    """Visits record after record and adds it to an index."""

    def __init__(self, source: Source, index: McapIndex, max_chunk_bytes: int) -> None:
        self._source = source
        self._window = Window(source)
        self._index = index
        self._max_chunk_bytes = max_chunk_bytes
        self._run: Extent | None = None
        """The messages outside chunks that directly precede the current record."""
        self._counts: dict[int, int] | None = {}
        self._damaged_chunks: dict[int, str] = {}
        """Reasons by offset."""
        index.is_walked = True

    def over(self, start: int, stop: int) -> None:
        """Visit every record from `start` to `stop`; after an invalid record, continue with the next chunk."""
        position = start
        while position < stop:
            head = self._window.peek(position, RECORD.size)
            op, length = RECORD.unpack(head) if len(head) == RECORD.size else (0, 0)
            end = position + RECORD.size + length
            if op in (Op.DATA_END, Op.FOOTER) and end <= stop:
                break
            if op == 0 or end > stop:
                next_chunk = find_chunk(self._source, position + 1, stop)
                resume_at = stop if next_chunk is None else next_chunk
                self._distrust_last_chunk(position)
                self._add_invalid(op, position, end, resume_at)
                position = resume_at
                continue
            self._add_record(op, position, end)
            position = end
        else:
            self._distrust_last_chunk(position)
        self._finish_run()
        self._index.data_end = position
        self._add_totals()

    def _add_record(self, op: int, start: int, end: int) -> None:
        if op == Op.MESSAGE:
            self._add_message(start, end)
            return
        self._finish_run()
        if op == Op.CHUNK:
            self._add_chunk(start, end)
        elif op == Op.MESSAGE_INDEX:
            self._add_message_index(start, end)
        elif op == Op.ATTACHMENT:
            self._index.attachments.append((start + RECORD.size, end))
        elif op == Op.METADATA:
            self._index.metadata.append((start + RECORD.size, end))
        elif op in (Op.SCHEMA, Op.CHANNEL):
            content = start + RECORD.size
            try:
                _add_description(op, Fields(self._source.read(content, end - content)), self._index)
            except BagError as err:
                self._add_unreadable(start, f"a damaged record of kind {op}: {err.what}")

    def _add_unreadable(self, offset: int, reason: str) -> None:
        self._index.unreadable.append(UnreadableRange(offset, reason))

    def _add_invalid(self, op: int, start: int, end: int, stop: int) -> None:
        """Add an unreadable range, or a truncated chunk, which may still contain messages."""
        self._counts = None
        if op == Op.CHUNK:
            try:
                head = chunk_head(self._source.read(start, min(stop - start, _CHUNK_HEAD_BYTES)))
            except BagError:
                head = None
            if head is not None:
                extent = Extent(start, stop, head.start_ns, head.end_ns, is_truncated=True)
                self._index.extents.append(extent)
                size = self._add_chunk_descriptions(extent)
                self._add_unreadable(
                    start, f"the chunk is truncated; {size} of its {head.size} bytes could be read"
                )
                return
        record = f"a record of kind {op} with {end - start} bytes" if op else "no record"
        self._add_unreadable(start, f"{record} where {stop - start} bytes are left; they are not read")

    def _distrust_last_chunk(self, position: int) -> None:
        """Drop the message indexes before `position`: where a file is truncated, some of them may be missing."""
        extents = self._index.extents
        if extents and extents[-1].stop == position and extents[-1].is_chunk:
            extents[-1] = replace(extents[-1], indexes=b"")
            self._counts = None
            self._add_chunk_descriptions(extents[-1])

    def _add_message(self, start: int, end: int) -> None:
        fields = self._window.peek(start + RECORD.size, _MESSAGE.size)
        if min(len(fields), end - start - RECORD.size) < _MESSAGE.size:
            self._finish_run()
            self._add_unreadable(start, f"a message record of {end - start} bytes, too few for its fields")
            return
        channel, _, time_ns = _MESSAGE.unpack(fields)
        if self._counts is not None:
            self._counts[channel] = self._counts.get(channel, 0) + 1
        run = self._run
        if run is not None and end - run.offset > _RUN_BYTES:
            self._finish_run()
            run = None
        if run is None:
            self._run = Extent(start, end, time_ns, time_ns, is_chunk=False)
        else:
            first_ns, last_ns = min(run.start_ns, time_ns), max(run.end_ns, time_ns)
            self._run = replace(run, stop=end, start_ns=first_ns, end_ns=last_ns)

    def _finish_run(self) -> None:
        if self._run is not None:
            self._index.extents.append(self._run)
            self._run = None

    def _add_chunk(self, start: int, end: int) -> None:
        try:
            head = chunk_head(self._source.read(start, min(end - start, _CHUNK_HEAD_BYTES)))
        except BagError as err:
            self._add_unreadable(start, f"a damaged chunk record: {err.what}")
            return
        extent = Extent(start, end, head.start_ns, head.end_ns, size=head.size)
        self._index.extents.append(extent)
        following = self._window.peek(end, 1)
        if following != bytes([Op.MESSAGE_INDEX]) and head.size:
            self._counts = None
            self._add_chunk_descriptions(extent)

    def _add_message_index(self, start: int, end: int) -> None:
        """Add a message index to the chunk that precedes it."""
        extents = self._index.extents
        fields = self._window.peek(start + RECORD.size, 6)
        if not extents or extents[-1].stop != start or end - start < RECORD.size + 6:
            return
        channel, size = struct.unpack("<HI", fields)
        if self._counts is not None:
            self._counts[channel] = self._counts.get(channel, 0) + size // _INDEX_ENTRY_BYTES
        chunk = extents[-1]
        entry = struct.pack("<HQ", channel, start)
        extents[-1] = replace(chunk, stop=end, indexes=chunk.indexes + entry)
        if channel not in self._index.channels:
            self._add_chunk_descriptions(chunk)

    def _add_chunk_descriptions(self, extent: Extent) -> int:
        """Add the schemas and channels inside a chunk; return the number of bytes that could be decompressed."""
        size = 0
        try:
            data = self._source.read(extent.offset, extent.stop - extent.offset)
            head = chunk_head(data)
            compressed = memoryview(data)[head.start : head.end]
            records = decompress_partially(
                compressed, head.compression, head.size, limit=self._max_chunk_bytes
            ).data
            size = len(records)
            for op, start, end in records_in(records):
                _add_description(op, Fields(records, start, end), self._index)
        except BagError as err:
            self._damaged_chunks[extent.offset] = err.what
        return size

    def report_undescribed_chunks(self) -> None:
        """Report damaged chunks if the file describes no channel: its chunks will not be read then."""
        if not self._index.channels:
            for offset, reason in self._damaged_chunks.items():
                self._add_unreadable(offset, f"broken chunk: {reason}")

    def _add_totals(self) -> None:
        index = self._index
        index.counts = index.counts or self._counts
        timed = [extent for extent in index.extents if extent.end_ns]
        if timed:
            index.start_ns = min(extent.start_ns for extent in timed)
            index.end_ns = max(extent.end_ns for extent in timed)
