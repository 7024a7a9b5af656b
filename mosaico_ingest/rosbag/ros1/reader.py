"""The reader of ROS 1 bags, version 2.0.

Messages of a chunk are located through its index records, with array operations over all chunks that are read together.
A chunk whose index is wrong is scanned record by record.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from functools import partial

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.blocks import (
    Bytes,
    Encoding,
    Int64s,
    MessageBlock,
    ReadRequest,
    ReadResult,
    ReadTask,
    SplitConnection,
    UnreadableRange,
    add_selected,
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
from mosaico_ingest.rosbag.ros1.index import (
    ChunkHead,
    Extent,
    Op,
    Ros1Index,
    chunk_head,
    index_entries,
    messages_in,
    number,
    read_index,
    records_in,
    time_of,
    times_of,
)
from mosaico_ingest.rosbag.source import ReadBuffer, Source

_MAX_LAYOUTS = 4
"""Maximum number of header layouts per connection; with more, chunks are scanned record by record."""
_HEAD_BYTES = 1 << 12
"""Bytes to read for the header of a chunk record; more than it can take."""
_MAX_CHUNKS = 16
"""Maximum number of chunks per read: their decompressed size is unknown until they are read."""


class _Chunk(Struct, frozen=True):
    """The records of an extent, decompressed."""

    extent: Extent
    index: memoryview
    """The index records after the chunk."""
    buffer: Bytes
    """The buffer that holds the records of all chunks decompressed together."""
    start: int
    end: int

    @property
    def is_indexed(self) -> bool:
        """Whether index records locate the messages."""
        return self.extent.is_chunk and not self.extent.is_truncated

    @property
    def records(self) -> Bytes:
        """The records of this chunk."""
        return self.buffer[self.start : self.end]


class Ros1Reader:
    """The reader of one `.bag` file, which may lack its index or its end."""

    container = "ros1"

    def __init__(self, source: Source, max_chunk_bytes: int = MAX_CHUNK_BYTES) -> None:
        self.path = source.path
        self._source = source
        self._max_chunk_bytes = max_chunk_bytes
        try:
            self._index = read_index(source, max_chunk_bytes)
        except BaseException:
            self._source.close()
            raise
        self._extents = sorted(self._index.extents, key=lambda extent: extent.start_ns)
        counts: dict[int, int] = {}
        for extent in self._index.extents:
            for key, count in extent.counts.items():
                counts[key] = counts.get(key, 0) + count
        filled = [extent for extent in self._index.extents if extent.counts]
        self.connections: tuple[SplitConnection, ...] = _connections(self._index, counts)
        self.start_ns: int | None = min((extent.start_ns for extent in filled), default=None)
        self.end_ns: int | None = max((extent.end_ns for extent in filled), default=None)
        self.message_count: int | None = sum(counts.values())
        self.unreadable: list[UnreadableRange] = [
            *self._index.unreadable,
            *undescribed_connections(counts, self._index.connections),
        ]
        self.notes: list[str] = source.notes

    def read_tasks(self, request: ReadRequest) -> Iterator[ReadTask]:
        """Yield tasks for the chunks that may contain requested messages."""
        keys = frozenset(request.connections)
        requested = [
            extent
            for extent in self._extents
            if extent.is_truncated
            or (request.overlaps(extent.start_ns, extent.end_ns) and extent.counts.keys() & keys)
        ]
        self._source.prefetch((extent.offset, extent.stop) for extent in requested)
        for group in group_by_bytes(
            requested, _compressed_bytes, request.block_bytes, max_length=_MAX_CHUNKS
        ):
            yield ReadTask(group[0].start_ns, partial(self._load, group, request))

    def index_times(self, connections: Collection[int]) -> dict[int, list[Int64s]] | None:
        """Return the log times of some connections according to the index records; None if a chunk has none."""
        times: dict[int, list[Int64s]] = {key: [] for key in connections}
        for extent in self._extents:
            if extent.is_truncated or (extent.counts.keys() & times.keys() and not extent.is_chunk):
                return None
            if not extent.counts.keys() & times.keys():
                continue
            try:
                head = _chunk_head_at(self._source, extent)
                start = extent.offset + head.end
                index = memoryview(self._source.read(start, extent.stop - start))
                chunk = _Chunk(extent, index, np.zeros(0, np.uint8), 0, 0)
                for key, entries in _chunk_indexes(chunk, times).items():
                    times[key].append(times_of(entries))
            except BagError:
                return None
        return times

    def check_unchanged(self) -> None:
        """See `Source.check_unchanged`."""
        self._source.check_unchanged()

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    def _load(self, extents: Sequence[Extent], request: ReadRequest) -> ReadResult:
        result = ReadResult([], [])
        for chunks in self._read_chunks(extents, request, result):
            indexed = [chunk for chunk in chunks if chunk.is_indexed]
            if indexed:
                _add_indexed(indexed, request, result)
            for chunk in chunks:
                if not chunk.is_indexed:
                    _add_scanned(chunk, request, result)
        return result

    def _read_chunks(
        self, extents: Sequence[Extent], request: ReadRequest, result: ReadResult
    ) -> Iterator[list[_Chunk]]:
        """Read and decompress extents; the indexed chunks of each list share one buffer."""
        compressed: list[tuple[Extent, memoryview, CompressedChunk]] = []
        buffer = ReadBuffer(self._source, ((extent.offset, extent.stop) for extent in extents))
        for extent in extents:
            try:
                position = buffer.read(extent.offset, extent.stop)
                raw = buffer.data[position].data
                head = _chunk_head(raw, extent) if extent.is_chunk else None
                if head is None:
                    yield [_unindexed(extent, np.frombuffer(raw, np.uint8))]
                elif extent.is_truncated:
                    yield [self._truncated_chunk(extent, raw, head)]
                else:
                    start, end = position.start + head.start, position.start + head.end
                    chunk = CompressedChunk(start, end, head.compression, head.size)
                    compressed.append((extent, raw[head.end :], chunk))
            except BagError as err:  # noqa: PERF203 - each chunk may be damaged
                result.unreadable.extend(_unreadable_chunk(extent, request, err))
        for group in decompression_groups(compressed, lambda item: item[2].size):
            decompressed = decompress_chunks(
                buffer.data, [chunk for *_, chunk in group], limit=self._max_chunk_bytes
            )
            chunks: list[_Chunk] = []
            for number_in_group, (extent, index, _) in enumerate(group):
                if number_in_group in decompressed.errors:
                    error = decompressed.errors[number_in_group]
                    result.unreadable.extend(_unreadable_chunk(extent, request, error))
                else:
                    bounds = decompressed.bounds[number_in_group]
                    chunks.append(_Chunk(extent, index, decompressed.data, *bounds))
            yield chunks

    def _truncated_chunk(self, extent: Extent, raw: memoryview, head: ChunkHead) -> _Chunk:
        records = decompress_partially(
            raw[head.start : head.end], head.compression, head.size, limit=self._max_chunk_bytes
        )
        return _unindexed(extent, records)


def _connections(index: Ros1Index, counts: dict[int, int]) -> tuple[SplitConnection, ...]:
    return tuple(
        SplitConnection(
            key,
            connection.topic,
            connection.msgtype,
            Encoding.ROS1,
            1,
            Embedded("ros1msg", connection.definition),
            counts.get(key, 0),
            latched=connection.attributes.get("latching") == "1",
            attributes={"encoding": "ros1", **connection.attributes},
        )
        for key, connection in sorted(index.connections.items())
    )


def _compressed_bytes(extent: Extent) -> int:
    return extent.stop - extent.offset


def _unindexed(extent: Extent, records: Bytes) -> _Chunk:
    return _Chunk(extent, memoryview(b""), records, 0, len(records))


def _chunk_head(raw: memoryview, extent: Extent) -> ChunkHead:
    head = chunk_head(raw)
    if head.end > len(raw) and not extent.is_truncated:
        raise BagError(f"{head.end - head.start} bytes announced, {len(raw) - head.start} left")
    return head


def _chunk_head_at(source: Source, extent: Extent) -> ChunkHead:
    return chunk_head(source.read(extent.offset, min(extent.stop - extent.offset, _HEAD_BYTES)))


def _unreadable_chunk(extent: Extent, request: ReadRequest, err: BagError) -> Iterator[UnreadableRange]:
    """Yield the unreadable range of a chunk for each requested connection, with its count."""
    reason = f"broken chunk: {err.what}"
    for key in extent.counts.keys() & request.connections:
        yield UnreadableRange(
            extent.offset,
            reason,
            connection=key,
            count=extent.counts[key],
            start_ns=extent.start_ns,
            end_ns=extent.end_ns,
        )


def _add_indexed(chunks: Sequence[_Chunk], request: ReadRequest, result: ReadResult) -> None:
    """Add the requested messages through the index records; scan chunks whose index is wrong."""
    try:
        blocks = _indexed_messages(chunks, request.connections)
    except BagError as err:
        if len(chunks) > 1:
            for chunk in chunks:
                _add_indexed([chunk], request, result)
            return
        reason = f"{err.what}; the chunk was read record by record"
        result.unreadable.append(UnreadableRange(chunks[0].extent.offset, reason, count=0))
        _add_scanned(chunks[0], request, result)
        return
    for block in blocks:
        add_selected(block, request, result)


def _indexed_messages(chunks: Sequence[_Chunk], connections: Collection[int]) -> list[MessageBlock]:
    """Return the messages that the chunks' index records list for some connections, a block for each.

    Raises:
        BagError: The index does not match the message records.
    """
    buffer = chunks[0].buffer
    starts_of = np.array([chunk.start for chunk in chunks], np.int64)
    ends_of = np.array([chunk.end for chunk in chunks], np.int64)
    offsets_of = np.array([chunk.extent.offset for chunk in chunks], np.int64)
    indexes: dict[int, list[tuple[int, NDArray[np.void]]]] = {}
    for owner, chunk in enumerate(chunks):
        for key, entries in _chunk_indexes(chunk, connections).items():
            indexes.setdefault(key, []).append((owner, entries))
    blocks: list[MessageBlock] = []
    for key, of_chunks in indexes.items():
        owners = np.repeat([owner for owner, _ in of_chunks], [len(entries) for _, entries in of_chunks])
        entries = np.concatenate([entries for _, entries in of_chunks])
        records = starts_of[owners] + entries["offset"].astype(np.int64)
        times = times_of(entries)
        starts, lengths = _locate_payloads(buffer, key, records, times, ends_of[owners])
        blocks.append(MessageBlock(key, times, buffer, starts, lengths, offsets_of[owners]))
    return blocks


def _chunk_indexes(chunk: _Chunk, connections: Collection[int]) -> dict[int, NDArray[np.void]]:
    """Return the index entries of a chunk by requested connection.

    Raises:
        BagError: An index record is missing, or its count differs from that in the bag's index.
    """
    counts = chunk.extent.counts
    keys = {key for key, count in counts.items() if count and key in connections}
    indexes: dict[int, NDArray[np.void]] = {}
    for record in records_in(chunk.index) if keys else ():
        if record.op == Op.INDEX:
            key, entries = index_entries(record, chunk.index)
            if key in keys and len(entries) == counts[key]:
                indexes[key] = entries
            if indexes.keys() == keys:
                break
    if indexes.keys() != keys:
        raise BagError("an index record is missing")
    return indexes


class _HeadLayout(Struct, frozen=True):
    """The positions of the fields before the payload of a message record, which writers may order freely."""

    skipped_bytes: int
    """Bytes of connection records between the position in the index and the message record."""
    size: int
    """Bytes of the message record before its payload."""
    is_constant: NDArray[np.bool_]
    """Which of these bytes are equal in all messages of this layout."""
    connection_at: int
    time_at: int


def _locate_payloads(
    buffer: Bytes, key: int, records: Int64s, times: Int64s, ends: Int64s
) -> tuple[Int64s, Int64s]:
    """Return starts and lengths of the payloads of a connection's messages.

    The first message determines a layout of the header; all messages with the same layout are checked together, and
    the procedure is repeated for the others.

    Raises:
        BagError: The index does not match the message records.
    """
    starts, lengths = np.empty_like(records), np.empty_like(records)
    remaining = np.arange(len(records))
    for _ in range(_MAX_LAYOUTS):
        if not len(remaining):
            return starts, lengths
        first = remaining[0]
        layout = _head_layout(buffer[records[first] : ends[first]])
        matches, starts[remaining], lengths[remaining] = _match_layout(
            buffer, layout, key, records[remaining], times[remaining], ends=ends[remaining]
        )
        if not matches[0]:
            break
        remaining = remaining[~matches]
    raise BagError("an index record does not point at its messages")


def _match_layout(
    buffer: Bytes, layout: _HeadLayout, key: int, records: Int64s, times: Int64s, *, ends: Int64s
) -> tuple[NDArray[np.bool_], Int64s, Int64s]:
    """Return which messages have the layout and match the index, and starts and lengths of their payloads.

    Raises:
        BagError: A message would be outside its chunk.
    """
    heads_at = records + layout.skipped_bytes
    if bool((heads_at > ends - layout.size).any()):
        raise BagError("an index record points outside its chunk")
    heads = fixed_slices(buffer, heads_at, layout.size)
    matches = (heads[:, layout.is_constant] == heads[0, layout.is_constant]).all(axis=1)
    stamps = _words(heads, layout.time_at, 2).astype(np.int64)
    lengths = _words(heads, layout.size - 4, 1).astype(np.int64).reshape(-1)
    matches &= _words(heads, layout.connection_at, 1).reshape(-1) == key
    matches &= stamps[:, 0] * 1_000_000_000 + stamps[:, 1] == times
    matches &= heads_at + layout.size + lengths <= ends
    return matches, heads_at + layout.size, lengths


def _words(heads: Bytes, position: int, count: int) -> NDArray[np.uint32]:
    return np.ascontiguousarray(heads[:, position : position + 4 * count]).view("<u4")


def _head_layout(data: Bytes) -> _HeadLayout:
    """Return the layout of the first message record in `data`, which connection records may precede.

    Raises:
        BagError: There is no message record.
    """
    skipped_bytes = 0
    for record in records_in(data.data):
        if record.op == Op.MESSAGE:
            break
        skipped_bytes = record.end
    else:
        raise BagError("an index record points at no message")
    number(record.header, b"conn", 4)
    time_of(record.header, b"time")
    head = data[record.offset : record.start].tobytes()
    connection_at, time_at = head.find(b"conn=") + 5, head.find(b"time=") + 5
    is_constant = np.ones(len(head), np.bool_)
    for start, size in ((connection_at, 4), (time_at, 8), (len(head) - 4, 4)):
        is_constant[start : start + size] = False
    return _HeadLayout(skipped_bytes, len(head), is_constant, connection_at, time_at)


def _add_scanned(chunk: _Chunk, request: ReadRequest, result: ReadResult) -> None:
    """Add the requested messages record by record, up to the first invalid record."""
    extent, data = chunk.extent, chunk.records
    messages: list[tuple[int, int, int, int, int]] = []
    try:
        for message in messages_in(data.data):
            messages.append(  # noqa: PERF401 - messages before an error are used
                (message.connection, message.time_ns, message.start, message.end, message.offset)
            )
    except BagError as err:
        result.unreadable.append(UnreadableRange(extent.offset, f"{err.what}; the rest is not read"))
    keys, times, starts, ends, records = np.array(messages, np.int64).reshape(-1, 5).T
    offsets = np.full(len(records), extent.offset, np.int64) if extent.is_chunk else records + extent.offset
    requested = [(key, rows) for key, rows in rows_by_connection(keys) if key in request.connections]
    block = MessageBlock(-1, times, data, starts, ends - starts, offsets)
    add_selected_rows(block, requested, request, result)
