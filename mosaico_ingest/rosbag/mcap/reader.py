"""The reader of MCAP files.

Messages of a chunk are located through its message indexes, with array operations over all chunks that are read
together. A chunk whose indexes are missing or wrong is scanned record by record.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator, Sequence
from functools import cached_property, partial
from itertools import pairwise
from operator import itemgetter

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.blocks import (
    EARLIEST_NS,
    LATEST_NS,
    Attachment,
    Bytes,
    ChunkChecksum,
    Encoding,
    Int64s,
    MessageBlock,
    ReadRequest,
    ReadResult,
    ReadTask,
    SplitConnection,
    UnreadableRange,
    add_selected_rows,
    fixed_slices,
    group_by_bytes,
    rows_by_connection,
    undescribed_connections,
)
from mosaico_ingest.rosbag.compression import (
    MAX_CHUNK_BYTES,
    CompressedChunk,
    decompress_chunks,
    decompress_partially,
    decompression_groups,
)
from mosaico_ingest.rosbag.definitions.model import Embedded
from mosaico_ingest.rosbag.mcap.index import (
    RECORD,
    ChannelRecord,
    ChunkHead,
    Extent,
    KeptRecords,
    McapIndex,
    Op,
    SchemaRecord,
    attachment_chunks,
    chunk_head,
    read_extents,
    read_index,
    read_kept_records,
)
from mosaico_ingest.rosbag.source import ReadBuffer, Source

_ENCODINGS = {
    "cdr": Encoding.CDR,
    "ros1": Encoding.ROS1,
    "protobuf": Encoding.PROTOBUF,
    "json": Encoding.JSON,
}
_INDEX_ENTRY = np.dtype([("time", "<i8"), ("offset", "<u8")])
_MESSAGE_HEAD = np.dtype(
    [
        ("op", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("time", "<i8"),
        ("published", "<i8"),
    ]
)
_FIXED_BYTES = _MESSAGE_HEAD.itemsize - RECORD.size
"""The part of a message record's length that is not payload."""


class _Chunk(Struct, frozen=True):
    """The records of an extent, decompressed."""

    extent: Extent
    raw: memoryview
    """The extent as it is in the file: the chunk record and the message indexes after it."""
    buffer: Bytes
    """The buffer that holds the records of all chunks decompressed together."""
    start: int
    end: int

    @property
    def records(self) -> Bytes:
        """The records of this chunk."""
        return self.buffer[self.start : self.end]


class McapReader:
    """The reader of one MCAP file, which may lack its summary, indexes, chunks, profile or end."""

    container = "mcap"

    def __init__(self, source: Source, max_chunk_bytes: int = MAX_CHUNK_BYTES) -> None:
        self.path = source.path
        self._source = source
        self._max_chunk_bytes = max_chunk_bytes
        try:
            self._index = read_index(source, max_chunk_bytes)
        except BaseException:
            self._source.close()
            raise
        index = self._index
        self.connections: tuple[SplitConnection, ...] = tuple(
            _connection(key, channel, index) for key, channel in sorted(index.channels.items())
        )
        self.start_ns: int | None = index.start_ns
        self.end_ns: int | None = index.end_ns
        self.message_count: int | None = sum(index.counts.values()) if index.counts is not None else None
        self.unreadable: list[UnreadableRange] = [
            *index.unreadable,
            *undescribed_connections(index.counts, index.channels),
        ]
        self.notes: list[str] = source.notes
        self.chunk_checksums: dict[int, ChunkChecksum] = {}
        """The checksum of each chunk that was read, by the offset of the chunk."""
        self._extents: tuple[list[Extent], list[UnreadableRange]] | None = None

    def read_tasks(self, request: ReadRequest) -> Iterator[ReadTask]:
        """Yield tasks for the chunks, and the messages between chunks, that may contain requested messages."""
        extents, unreadable = self._all_extents()
        if unreadable:
            yield ReadTask(EARLIEST_NS, lambda: ReadResult([], list(unreadable)))
        requested = [
            extent
            for extent in extents
            if request.overlaps(extent.start_ns, extent.end_ns) and extent.has_any(request.connections)
        ]
        self._source.prefetch((extent.offset, extent.stop) for extent in requested)
        for group in group_by_bytes(requested, _decompressed_bytes, request.block_bytes):
            yield ReadTask(min(group[0].start_ns, LATEST_NS), partial(self._load, group, request))

    def metadata_records(self) -> dict[str, dict[str, str]]:
        """Return the entries of the metadata records by name; of two entries with one key, the later one."""
        records: dict[str, dict[str, str]] = {}
        for record in self._kept.metadata:
            records.setdefault(record.name, {}).update(record.entries)
        return records

    def attachments(self) -> tuple[Attachment, ...]:
        """Return the attachments without their content."""
        return self._kept.attachments

    def damaged_records(self) -> tuple[str, ...]:
        """Return one line for each metadata record and attachment that cannot be read."""
        return self._kept.damaged

    @cached_property
    def _kept(self) -> KeptRecords:
        return read_kept_records(self._source, self._index, self._max_chunk_bytes)

    def attachment_chunks(self, attachment: Attachment) -> Iterator[bytes]:
        """Yield the content of an attachment; see `index.attachment_chunks`."""
        return attachment_chunks(self._source, attachment)

    def index_times(self, connections: Collection[int]) -> dict[int, list[Int64s]] | None:
        """Return the log times of some connections according to the message indexes.

        None if a chunk has no index, or if its index has times outside the time range of the chunk.
        """
        extents, unreadable = self._all_extents()
        requested = [extent for extent in extents if extent.has_any(connections)]
        if unreadable or any(not extent.indexes for extent in requested):
            return None
        times: dict[int, list[Int64s]] = {key: [] for key in connections}
        for extent in requested:
            offsets = extent.index_offsets()
            start = min(offset for _, offset in offsets)
            try:
                raw = memoryview(self._source.read(start, extent.stop - start))
                indexes = replace(extent, offset=start)
                of_chunk = {
                    key: np.frombuffer(_index_entries(raw, indexes, key, offset), _INDEX_ENTRY)["time"]
                    for key, offset in offsets
                    if key in times
                }
            except BagError:
                return None
            all_times = np.concatenate(list(of_chunk.values()))
            if len(all_times) and (all_times.min() < extent.start_ns or all_times.max() > extent.end_ns):
                return None
            for key, of_connection in of_chunk.items():
                times[key].append(of_connection)
        return times

    def check_unchanged(self) -> None:
        """See `Source.check_unchanged`."""
        self._source.check_unchanged()

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    def _all_extents(self) -> tuple[list[Extent], list[UnreadableRange]]:
        if self._extents is None:
            self._extents = read_extents(self._source, self._index, self._max_chunk_bytes)
        return self._extents

    def _load(self, extents: Sequence[Extent], request: ReadRequest) -> ReadResult:
        result = ReadResult([], [])
        for chunks in self._read_chunks(extents, request, result):
            indexed = [chunk for chunk in chunks if chunk.extent.indexes]
            if indexed:
                self._add_indexed(indexed, request, result)
            for chunk in chunks:
                if not chunk.extent.indexes:
                    self._add_scanned(chunk, request, result)
        return result

    def _read_chunks(
        self, extents: Sequence[Extent], request: ReadRequest, result: ReadResult
    ) -> Iterator[list[_Chunk]]:
        """Read and decompress extents; the indexed chunks of each list share one buffer."""
        compressed: list[tuple[Extent, memoryview, ChunkHead, CompressedChunk]] = []
        buffer = ReadBuffer(self._source, ((extent.offset, extent.stop) for extent in extents))
        for extent in extents:
            raw = memoryview(b"")
            try:
                position = buffer.read(extent.offset, extent.stop)
                raw = buffer.data[position].data
                head = chunk_head(raw) if extent.is_chunk else None
                if head is None:
                    yield [_unchunked(extent, np.frombuffer(raw, np.uint8))]
                elif extent.is_truncated:
                    yield [self._truncated_chunk(extent, raw, head)]
                else:
                    start, end = position.start + head.start, position.start + min(head.end, len(raw))
                    compressed.append(
                        (extent, raw, head, CompressedChunk(start, end, head.compression, head.size))
                    )
            except BagError as err:
                result.unreadable.extend(_unreadable_chunk(extent, raw, request, err))
        for group in decompression_groups(compressed, lambda item: item[3].size):
            decompressed = decompress_chunks(
                buffer.data, [chunk for *_, chunk in group], limit=self._max_chunk_bytes
            )
            chunks: list[_Chunk] = []
            for number, (extent, raw, head, _) in enumerate(group):
                chunk = _Chunk(extent, raw, decompressed.data, *decompressed.bounds[number])
                error = decompressed.errors.get(number) or _checksum_error(chunk.records, head)
                self.chunk_checksums[extent.offset] = _checksum(head, error)
                if error:
                    result.unreadable.extend(_unreadable_chunk(extent, raw, request, error))
                else:
                    chunks.append(chunk)
            yield chunks

    def _truncated_chunk(self, extent: Extent, raw: memoryview, head: ChunkHead) -> _Chunk:
        records = decompress_partially(
            raw[head.start : head.end], head.compression, head.size, limit=self._max_chunk_bytes
        )
        return _unchunked(extent, records)

    def _add_indexed(self, chunks: Sequence[_Chunk], request: ReadRequest, result: ReadResult) -> None:
        """Add the requested messages through the message indexes; scan chunks whose index is wrong."""
        try:
            add_selected_rows(*_indexed_messages(chunks, request.connections), request, result)
        except BagError as err:
            if len(chunks) > 1:
                for chunk in chunks:
                    self._add_indexed([chunk], request, result)
                return
            reason = f"{err.what}; the chunk was read record by record"
            result.unreadable.append(UnreadableRange(chunks[0].extent.offset, reason, count=0))
            self._add_scanned(chunks[0], request, result)

    def _add_scanned(self, chunk: _Chunk, request: ReadRequest, result: ReadResult) -> None:
        """Add the requested messages record by record, up to the first invalid record."""
        extent, records = chunk.extent, chunk.records
        starts = _message_starts(records.data, extent, result)
        heads = _message_heads(records, starts)
        rows_of = list(rows_by_connection(heads["channel"]))
        requested = [(key, rows) for key, rows in rows_of if key in request.connections]
        offsets = np.full(len(starts), extent.offset, np.int64) if extent.is_chunk else starts + extent.offset
        add_selected_rows(_block(records, heads, starts, offsets), requested, request, result)
        if self._index.counts is None:
            others = {key: len(rows) for key, rows in rows_of if key not in request.connections}
            result.unreadable.extend(undescribed_connections(others, self._index.channels))


def _connection(key: int, channel: ChannelRecord, index: McapIndex) -> SplitConnection:
    schema = index.schemas.get(channel.schema, SchemaRecord("", "", b""))
    ros_version = 1 if channel.encoding == "ros1" or schema.encoding == "ros1msg" else 2
    counts = index.counts
    return SplitConnection(
        key,
        channel.topic,
        schema.name,
        _ENCODINGS.get(channel.encoding, Encoding.OTHER),
        ros_version,
        Embedded.from_bytes(schema.encoding, schema.data) if schema.encoding else None,
        counts.get(key, 0) if counts is not None else None,
        latched=channel.metadata.get("latching") == "1",
        attributes={"encoding": channel.encoding, "schema_encoding": schema.encoding, **channel.metadata},
    )


def _decompressed_bytes(extent: Extent) -> int:
    return max(extent.size, extent.stop - extent.offset)


def _unchunked(extent: Extent, records: Bytes) -> _Chunk:
    return _Chunk(extent, memoryview(b""), records, 0, len(records))


def _checksum_error(records: Bytes, head: ChunkHead) -> BagError | None:
    if not head.crc or (checksum := zlib.crc32(records.data)) == head.crc:
        return None
    return BagError(f"its checksum is {checksum:08x}, {head.crc:08x} expected")


def _checksum(head: ChunkHead, error: BagError | None) -> ChunkChecksum:
    if not head.crc:
        return ChunkChecksum.ABSENT
    return ChunkChecksum.VALID if error is None else ChunkChecksum.WRONG


def _unreadable_chunk(
    extent: Extent, raw: memoryview, request: ReadRequest, err: BagError
) -> Iterator[UnreadableRange]:
    """Yield the unreadable range of a chunk, per channel and with counts if its indexes are readable."""
    reason = f"broken chunk: {err.what}"
    unreadable = UnreadableRange(extent.offset, reason, start_ns=extent.start_ns, end_ns=extent.end_ns)
    if not extent.indexes:
        yield unreadable
    for key, offset in extent.index_offsets():
        if key in request.connections:
            try:
                count: int | None = len(_index_entries(raw, extent, key, offset)) // _INDEX_ENTRY.itemsize
            except BagError:
                count = None
            yield replace(unreadable, connection=key, count=count)


def _index_entries(raw: memoryview, extent: Extent, key: int, offset: int) -> memoryview:
    """Return the entries of one message index record, undecoded.

    Raises:
        BagError: There is no such record at the offset.
    """
    start = offset - extent.offset
    if not 0 <= start <= len(raw) - RECORD.size - 6:
        raise BagError(f"the message index of channel {key} is at {offset}, outside its chunk's extent")
    op, _, channel, size = struct.unpack_from("<BQHI", raw, start)
    start += RECORD.size + 6
    if op != Op.MESSAGE_INDEX or channel != key or size % _INDEX_ENTRY.itemsize or start + size > len(raw):
        raise BagError(f"no message index of channel {key} at {offset}")
    return raw[start : start + size]


def _indexed_messages(
    chunks: Sequence[_Chunk], channels: Collection[int]
) -> tuple[MessageBlock, list[tuple[int, slice]]]:
    """Return the messages that the chunks' indexes list for some channels, sorted by channel, and each channel's rows.

    Raises:
        BagError: An index record is missing, or an entry does not match its message record.
    """
    indexes = [
        (key, number, _index_entries(chunk.raw, chunk.extent, key, offset))
        for number, chunk in enumerate(chunks)
        for key, offset in chunk.extent.index_offsets()
        if key in channels
    ]
    indexes.sort(key=itemgetter(0))
    counts = [len(entries) // _INDEX_ENTRY.itemsize for _, _, entries in indexes]
    entries = np.frombuffer(b"".join(entries for _, _, entries in indexes), _INDEX_ENTRY)
    keys = np.repeat(np.array([key for key, _, _ in indexes], np.uint16), counts)
    owners = np.repeat(np.array([number for _, number, _ in indexes], np.int64), counts)
    block = _checked_messages(chunks, entries, keys, owners)
    edges = np.flatnonzero(np.diff(keys.astype(np.int64), prepend=-1, append=-1)).tolist()
    return block, [(int(keys[start]), slice(start, end)) for start, end in pairwise(edges)]


def _checked_messages(
    chunks: Sequence[_Chunk], entries: NDArray[np.void], keys: NDArray[np.uint16], owners: Int64s
) -> MessageBlock:
    """Return the messages of index entries, after comparing all entries with the message records.

    `keys` and `owners` are the channel and the chunk of each entry.

    Raises:
        BagError: An entry does not match its message record.
    """
    buffer = chunks[0].buffer
    starts_of = np.array([chunk.start for chunk in chunks], np.int64)[owners]
    ends = np.array([chunk.end for chunk in chunks], np.int64)[owners]
    last = ends - starts_of - _MESSAGE_HEAD.itemsize
    if bool((last < 0).any()) or bool((entries["offset"] > last.astype(np.uint64)).any()):
        raise BagError("a message index points outside its chunk")
    starts = starts_of + entries["offset"].astype(np.int64)
    heads = _message_heads(buffer, starts)
    length = heads["length"]
    is_valid = (
        (heads["op"] == Op.MESSAGE)
        & (heads["channel"] == keys)
        & (heads["time"] == entries["time"])
        & (length >= _FIXED_BYTES)
        & (length <= (ends - RECORD.size - starts).astype(np.uint64))
    )
    if not bool(is_valid.all()):
        raise BagError("a message index does not point at its messages")
    offsets = np.array([chunk.extent.offset for chunk in chunks], np.int64)[owners]
    return _block(buffer, heads, starts, offsets)


def _message_starts(data: memoryview, extent: Extent, result: ReadResult) -> Int64s:
    """Return the positions of the message records, up to the first invalid record."""
    starts: list[int] = []
    position = 0
    while position < len(data):
        op, length = RECORD.unpack_from(data, position) if position + RECORD.size <= len(data) else (0, 0)
        end = position + RECORD.size + length
        if op == 0 or end > len(data):
            reason = f"no complete record at byte {position} of {len(data)}; the rest is not read"
            result.unreadable.append(UnreadableRange(extent.offset, reason))
            break
        if op == Op.MESSAGE and length >= _FIXED_BYTES:
            starts.append(position)
        elif op == Op.MESSAGE:
            reason = f"a message record of {length} bytes at byte {position}, too few for its fields"
            result.unreadable.append(UnreadableRange(extent.offset, reason))
        position = end
    return np.array(starts, np.int64)


def _message_heads(records: Bytes, starts: Int64s) -> NDArray[np.void]:
    if not len(starts):
        return np.empty(0, _MESSAGE_HEAD)
    return fixed_slices(records, starts, _MESSAGE_HEAD.itemsize).view(_MESSAGE_HEAD).reshape(-1)


def _block(records: Bytes, heads: NDArray[np.void], starts: Int64s, offsets: Int64s) -> MessageBlock:
    """Return messages of any channels whose records have been checked."""
    lengths = heads["length"].astype(np.int64) - _FIXED_BYTES
    times = np.ascontiguousarray(heads["time"])
    published = heads["published"]
    publish_times = None if np.array_equal(published, times) else np.ascontiguousarray(published)
    numbers = heads["sequence"]
    sequences = numbers.astype(np.int64) if numbers.any() else None
    starts = starts + _MESSAGE_HEAD.itemsize
    return MessageBlock(-1, times, records, starts, lengths, offsets, publish_times, sequences)
