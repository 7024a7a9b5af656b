"""This file finds out what is where in an MCAP file: by its summary, or by walking over its records."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection
from dataclasses import dataclass, field

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.blocks import LATEST_NS, UnreadableRange
from mosaico_ingest.rosbag.compression import inflate_some
from mosaico_ingest.rosbag.formats import MCAP
from mosaico_ingest.rosbag.mcap.records import (
    RECORD,
    McapChannel,
    Op,
    Schema,
    channel_of,
    chunk_head,
    records_in,
    schema_of,
)
from mosaico_ingest.rosbag.recovery import next_mcap_chunk
from mosaico_ingest.rosbag.source import Fields, Source, Window

__all__ = ["McapIndex", "Piece", "read_index", "read_pieces"]

_FOOTER_BYTES = RECORD.size + 20
_INDEX_ENTRY_BYTES = 16
_RUN_BYTES = 4 << 20
"""How much of the messages outside chunks is read at once."""
_MESSAGE = struct.Struct("<HIQ")


class Piece(Struct, frozen=True):
    """Records that are read at once: a chunk with the message indexes behind it, or messages outside chunks."""

    offset: int
    stop: int
    start_ns: int
    end_ns: int
    indexes: bytes = b""
    """Channel (u16) and file offset (u64) of each message index; empty where there is none."""
    size: int = 0
    """Bytes of a chunk's data, as its index announces them; 0 where there is none."""
    is_chunk: bool = True
    is_cut: bool = False

    def has_any(self, keys: Collection[int]) -> bool:
        """Return whether there may be messages of these channels."""
        return not self.indexes or any(key in keys for key, _ in self.index_offsets())

    def index_offsets(self) -> list[tuple[int, int]]:
        """Return channel and file offset of each message index."""
        return list(struct.iter_unpack("<HQ", self.indexes))


@dataclass(slots=True)
class McapIndex:
    """What is where."""

    schemas: dict[int, Schema] = field(default_factory=dict[int, Schema])
    channels: dict[int, McapChannel] = field(default_factory=dict[int, McapChannel])
    pieces: list[Piece] = field(default_factory=list[Piece])
    counts: dict[int, int] | None = None
    """Messages by channel, where the file or a walk could tell."""
    start_ns: int | None = None
    end_ns: int | None = None
    data_end: int = 0
    """Where the summary, or what cannot be read, begins."""
    unreadable: list[UnreadableRange] = field(default_factory=list[UnreadableRange])
    walked: bool = False
    """Whether every record was looked at, and not only the summary."""


def read_index(source: Source) -> McapIndex:
    """Return what the summary says, or, where it is missing, incomplete or damaged, what a walk finds."""
    try:
        index = _summary(source)
    except BagError as err:
        index, problem = None, str(err)
    else:
        problem = None
    if index is not None:
        return index
    index = McapIndex(data_end=source.size)
    if problem:
        index.unreadable.append(
            UnreadableRange(source.size, f"{problem}; the file was read record by record", count=0)
        )
    source.fetch_whole()
    _Walk(source, index).over(len(MCAP), source.size)
    return index


def read_pieces(source: Source, index: McapIndex) -> tuple[list[Piece], list[UnreadableRange]]:
    """Return all pieces by time, also those that the summary does not name, and what is broken between its chunks."""
    known = sorted(index.pieces, key=lambda piece: piece.offset)
    found = McapIndex()
    at = len(MCAP)
    if not index.walked:
        walk = _Walk(source, found)
        for piece in known:
            if piece.offset > at:
                walk.over(at, piece.offset)
            at = max(at, piece.stop)
        walk.over(at, index.data_end)
    return sorted(known + found.pieces, key=lambda piece: piece.start_ns), found.unreadable


def _summary(source: Source) -> McapIndex | None:
    tail_at = source.size - _FOOTER_BYTES - len(MCAP)
    if tail_at < len(MCAP):
        raise BagError("the file ends without a footer")
    tail = source.read(tail_at, _FOOTER_BYTES + len(MCAP))
    if tail[0] != Op.FOOTER or tail[-len(MCAP) :] != MCAP:
        raise BagError("the file ends without a footer")
    begin, _, crc = struct.unpack_from("<QQI", tail, RECORD.size)
    if not begin:
        return None
    if not len(MCAP) <= begin <= tail_at:
        raise BagError(f"the footer puts the summary at {begin}, outside the file")
    data = source.read(begin, tail_at - begin)
    if crc and zlib.crc32(tail[: RECORD.size + 16], zlib.crc32(data)) != crc:
        raise BagError("the summary does not have the checksum that the footer gives it")
    return _from_summary(data, begin)


def _from_summary(data: bytes, begin: int) -> McapIndex | None:
    """Return the summary's content, or None where it does not say all that is needed."""
    index = McapIndex(data_end=begin)
    chunk_count: int | None = None
    for op, start, end in records_in(data):
        fields = Fields(data, start, end)
        if op == Op.CHUNK_INDEX:
            index.pieces.append(_indexed_chunk(fields, begin))
        elif op == Op.STATISTICS:
            chunk_count = _statistics(fields, index)
        else:
            _describe(op, fields, index)
    counts = index.counts
    if counts is None or chunk_count != len(index.pieces) or not index.channels.keys() >= counts.keys():
        return None
    return index


def _describe(op: int, fields: Fields, index: McapIndex) -> None:
    """Take note of a schema or channel record; others say nothing about what messages are."""
    if op == Op.SCHEMA:
        key, schema = schema_of(fields)
        index.schemas[key] = schema
    elif op == Op.CHANNEL:
        key, channel = channel_of(fields)
        index.channels[key] = channel


def _indexed_chunk(fields: Fields, data_end: int) -> Piece:
    start_ns, end_ns, offset, length = fields.u64(), fields.u64(), fields.u64(), fields.u64()
    indexes = fields.take(fields.u32())
    stop = offset + length + fields.u64()
    if stop > data_end or len(indexes) % 10:
        raise BagError(f"the chunk index at {offset} does not fit the file")
    fields.take(fields.u32() + 8)  # how it is compressed, and to how many bytes: the chunk says so too
    return Piece(offset, stop, start_ns, end_ns, indexes, fields.u64())


def _statistics(fields: Fields, index: McapIndex) -> int:
    total = fields.u64()
    fields.take(2 + 4 + 4 + 4)
    chunks = fields.u32()
    start_ns, end_ns = fields.u64(), fields.u64()
    index.counts = {channel: count for channel, count in fields.pairs("<HQ") if count}
    if max(start_ns, end_ns) > LATEST_NS:
        raise BagError(f"messages from {start_ns} to {end_ns} ns, which is after the year 2262")
    if total != sum(index.counts.values()):
        raise BagError(f"{total} messages in all, {sum(index.counts.values())} by channel")
    if total:
        index.start_ns, index.end_ns = start_ns, end_ns
    return chunks


class _Walk:
    """Goes from record to record and writes down what is there."""

    def __init__(self, source: Source, index: McapIndex) -> None:
        self._source = source
        self._window = Window(source)
        self._index = index
        self._run: Piece | None = None
        self._counts: dict[int, int] | None = {}
        index.walked = True

    def over(self, at: int, stop: int) -> None:
        """Look at every record from `at` to `stop`; where one does not fit, go on at the next chunk."""
        while at < stop:
            head = self._window.peek(at, RECORD.size)
            op, length = RECORD.unpack(head) if len(head) == RECORD.size else (0, 0)
            end = at + RECORD.size + length
            if op in (Op.DATA_END, Op.FOOTER) and end <= stop:
                break
            if op == 0 or end > stop:
                resumed = next_mcap_chunk(self._source, at + 1, stop)
                self._doubt_last_chunk(at)
                self._stray(op, at, end, stop if resumed is None else resumed)
                at = stop if resumed is None else resumed
                continue
            self._record(op, at, end)
            at = end
        else:
            self._doubt_last_chunk(at)
        self._finish_run()
        self._index.data_end = at
        self._summarise()

    def _record(self, op: int, at: int, end: int) -> None:
        if op == Op.MESSAGE:
            self._message(at, end)
            return
        self._finish_run()
        if op == Op.CHUNK:
            self._chunk(at, end)
        elif op == Op.MESSAGE_INDEX:
            self._message_index(at, end)
        elif op in (Op.SCHEMA, Op.CHANNEL):
            start = at + RECORD.size
            try:
                _describe(op, Fields(self._source.read(start, end - start)), self._index)
            except BagError as err:
                self._index.unreadable.append(
                    UnreadableRange(at, f"a damaged record of kind {op}: {err.what}")
                )

    def _stray(self, op: int, at: int, end: int, stop: int) -> None:
        """Say what does not fit; a chunk that is cut off may still hold messages."""
        if op == Op.CHUNK:
            try:
                head = chunk_head(self._source.read(at, min(stop - at, 1 << 12)))
            except BagError:
                head = None
            if head is not None:
                piece = Piece(at, stop, head.start_ns, head.end_ns, is_cut=True)
                self._index.pieces.append(piece)
                self._counts = None
                self._learn(piece)
                return
        found = f"a record of kind {op} with {end - at} bytes" if op else "no record"
        self._index.unreadable.append(
            UnreadableRange(at, f"{found} where {stop - at} bytes are left; they are not read")
        )
        self._counts = None

    def _doubt_last_chunk(self, at: int) -> None:
        """Forget the message indexes that end at `at`, where the file may have been cut off: some may be missing."""
        pieces = self._index.pieces
        if pieces and pieces[-1].stop == at and pieces[-1].is_chunk:
            pieces[-1] = replace(pieces[-1], indexes=b"")
            self._counts = None
            self._learn(pieces[-1])

    def _message(self, at: int, end: int) -> None:
        fixed = self._window.peek(at + RECORD.size, _MESSAGE.size)
        if min(len(fixed), end - at - RECORD.size) < _MESSAGE.size:
            self._finish_run()
            self._index.unreadable.append(
                UnreadableRange(at, f"a message record of {end - at} bytes, too few for its fields")
            )
            return
        channel, _, time_ns = _MESSAGE.unpack(fixed)
        if self._counts is not None:
            self._counts[channel] = self._counts.get(channel, 0) + 1
        run = self._run
        if run is not None and end - run.offset > _RUN_BYTES:
            self._finish_run()
            run = None
        start_ns, end_ns = (
            (min(run.start_ns, time_ns), max(run.end_ns, time_ns)) if run else (time_ns, time_ns)
        )
        self._run = Piece(run.offset if run else at, end, start_ns, end_ns, is_chunk=False)

    def _finish_run(self) -> None:
        if self._run is not None:
            self._index.pieces.append(self._run)
            self._run = None

    def _chunk(self, at: int, end: int) -> None:
        try:
            head = chunk_head(self._source.read(at, min(end - at, 1 << 12)))
        except BagError as err:
            self._index.unreadable.append(UnreadableRange(at, f"a damaged chunk record: {err.what}"))
            return
        piece = Piece(at, end, head.start_ns, head.end_ns, size=head.size)
        self._index.pieces.append(piece)
        following = self._window.peek(end, 1)
        if following != bytes([Op.MESSAGE_INDEX]) and head.size:
            self._counts = None
            self._learn(piece)

    def _message_index(self, at: int, end: int) -> None:
        """Add a message index to the chunk before it."""
        pieces = self._index.pieces
        fixed = self._window.peek(at + RECORD.size, 6)
        if not pieces or pieces[-1].stop != at or end - at < RECORD.size + 6:
            return
        channel, size = struct.unpack("<HI", fixed)
        if self._counts is not None:
            self._counts[channel] = self._counts.get(channel, 0) + size // _INDEX_ENTRY_BYTES
        last = pieces[-1]
        entry = struct.pack("<HQ", channel, at)
        pieces[-1] = replace(last, stop=end, indexes=last.indexes + entry)
        if channel not in self._index.channels:
            self._learn(last)

    def _learn(self, piece: Piece) -> None:
        """Take note of the schemas and channels inside a chunk."""
        try:
            data = self._source.read(piece.offset, piece.stop - piece.offset)
            head = chunk_head(data)
            records = inflate_some(data[head.begin : head.end], head.compression, head.size)
            for op, start, end in records_in(records):
                _describe(op, Fields(records, start, end), self._index)
        except BagError:
            return  # reading the chunk will say what is wrong with it

    def _summarise(self) -> None:
        index = self._index
        counted = self._counts
        index.counts = index.counts or counted
        filled = [piece for piece in index.pieces if piece.end_ns]
        if filled:
            index.start_ns = min(piece.start_ns for piece in filled)
            index.end_ns = max(piece.end_ns for piece in filled)
