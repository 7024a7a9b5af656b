"""The index of a ROS 1 bag: from its index section, or from a walk over its records."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.blocks import UnreadableRange
from mosaico_ingest.rosbag.compression import MAX_CHUNK_BYTES, decompress_partially
from mosaico_ingest.rosbag.ros1.records import (
    ConnectionRecord,
    Op,
    Record,
    chunk_head,
    connection_of,
    find_chunk,
    index_entries,
    messages_in,
    number,
    record_at,
    time_of,
    times_of,
)
from mosaico_ingest.rosbag.source import Source, Window

_VERSION = b"#ROSBAG V2.0\n"
_RUN_BYTES = 4 << 20
"""Maximum size of an extent of messages outside chunks."""


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
