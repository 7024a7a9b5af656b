"""This file finds out what is where in a ROS 1 bag: by its index, or by walking over its records."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.blocks import UnreadableRange
from mosaico_ingest.rosbag.compression import inflate_some
from mosaico_ingest.rosbag.recovery import next_ros1_chunk
from mosaico_ingest.rosbag.ros1.records import (
    Connection,
    Op,
    Record,
    chunk_head,
    connection_of,
    index_entries,
    messages_in,
    number,
    record_at,
    time_of,
    times_of,
)
from mosaico_ingest.rosbag.source import Source, Window

__all__ = ["Piece", "Ros1Index", "read_index"]

_VERSION = b"#ROSBAG V2.0\n"
_RUN_BYTES = 4 << 20
"""How much of the messages outside chunks is read at once."""


class Piece(Struct, frozen=True):
    """A chunk and the index records behind it, read at once; or messages outside chunks."""

    offset: int
    stop: int
    start_ns: int
    end_ns: int
    counts: dict[int, int]
    """Messages by connection."""
    is_chunk: bool = True
    is_cut: bool = False


@dataclass(slots=True)
class Ros1Index:
    """What is where."""

    connections: dict[int, Connection] = field(default_factory=dict[int, Connection])
    pieces: list[Piece] = field(default_factory=list[Piece])
    unreadable: list[UnreadableRange] = field(default_factory=list[UnreadableRange])


def read_index(source: Source) -> Ros1Index:
    """Return what the bag's index says, or, where it is missing or damaged, what a walk finds.

    Raises:
        BagError: The bag is encrypted, of another version, or does not even have its first record whole.
    """
    window = Window(source)
    line = window.peek(0, len(_VERSION))
    if line != _VERSION:
        version = re.split(rb"[\r\n]", window.peek(0, 32))[0].decode("ascii", "replace")
        raise BagError(
            f"bag format {version!r}; V2.0 and V1.2 are read",
            where=str(source.path),
            hint="convert it with `rosbag fix`",
        )
    head = record_at(window, len(_VERSION), source.size)
    if head.op != Op.BAG:
        raise BagError(f"a record of kind {head.op} where the bag's header must be", where=str(source.path))
    if head.header.get(b"encryptor"):
        name = head.header[b"encryptor"].decode("ascii", "replace")
        raise BagError(
            f"the bag is encrypted by {name!r}", where=str(source.path), hint="decrypt it with rosbag"
        )
    index_at = number(head.header, b"index_pos", 8)
    problem = None if index_at else "the bag was not closed and has no index"
    if index_at:
        source.prefetch([(index_at, source.size)])
        try:
            return _from_index(source, window, head, index_at)
        except BagError as err:
            problem = f"its index is damaged ({err.what})"
    index = Ros1Index()
    index.unreadable.append(
        UnreadableRange(len(_VERSION), f"{problem}; the file was read record by record", count=0)
    )
    source.fetch_whole()
    _Walk(source, index).over(head.end, source.size)
    return index


def _from_index(source: Source, window: Window, head: Record, index_at: int) -> Ros1Index:
    index = Ros1Index()
    places: list[tuple[int, int, int, dict[int, int]]] = []
    at = index_at
    wanted = number(head.header, b"conn_count", 4), number(head.header, b"chunk_count", 4)
    while at < source.size and (len(index.connections), len(places)) != wanted:
        record = record_at(window, at, source.size)
        data = window.peek(record.begin, record.end - record.begin)
        if record.op == Op.CONNECTION:
            index.connections[number(record.header, b"conn", 4)] = connection_of(record, data)
        elif record.op == Op.CHUNK_INFO:
            places.append(_chunk_info(record, data, index_at))
        at = record.end
    if (len(index.connections), len(places)) != wanted:
        raise BagError(f"{wanted[0]} connections and {wanted[1]} chunks promised, not as many found")
    starts = sorted(place[0] for place in places)
    stops = dict(zip(starts, [*starts[1:], index_at], strict=False))
    if any(key not in index.connections for place in places for key in place[3]):
        raise BagError("messages of a connection that is not described")
    index.pieces = [Piece(at, stops[at], first, last, counts) for at, first, last, counts in places]
    return index


def _chunk_info(record: Record, data: bytes, index_at: int) -> tuple[int, int, int, dict[int, int]]:
    at = number(record.header, b"chunk_pos", 8)
    pairs = np.frombuffer(data[: len(data) // 8 * 8], "<u4").reshape(-1, 2).tolist()
    if (
        number(record.header, b"ver", 4) != 1
        or number(record.header, b"count", 4) != len(pairs)
        or at >= index_at
    ):
        raise BagError(f"a chunk info that does not fit the chunk at {at}")
    counts = {int(key): int(count) for key, count in pairs}
    return at, time_of(record.header, b"start_time"), time_of(record.header, b"end_time"), counts


class _Walk:
    """Goes from record to record and writes down what is there."""

    def __init__(self, source: Source, index: Ros1Index) -> None:
        self._source = source
        self._window = Window(source)
        self._index = index

    def over(self, at: int, stop: int) -> None:
        """Look at every record; where one does not fit, go on at the next chunk."""
        while at < stop:
            try:
                record = record_at(self._window, at, stop)
            except BagError as err:
                resumed = next_ros1_chunk(self._source, at + 1, stop)
                self._doubt_last_chunk(at)
                self._stray(at, stop if resumed is None else resumed, err.what)
                at = stop if resumed is None else resumed
                continue
            try:
                self._record(record)
            except BagError as err:
                self._index.unreadable.append(
                    UnreadableRange(at, f"a damaged record of kind {record.op}: {err.what}")
                )
            at = record.end
        self._doubt_last_chunk(at)

    def _doubt_last_chunk(self, at: int) -> None:
        """Count messages, not index entries, where the file may have been cut off: some indexes may be missing."""
        pieces = self._index.pieces
        if pieces and pieces[-1].is_chunk and pieces[-1].stop == at:
            pieces[-1] = self._by_messages(pieces[-1])

    def _record(self, record: Record) -> None:
        pieces = self._index.pieces
        if record.op == Op.CHUNK:
            pieces.append(Piece(record.at, record.end, 0, 0, {}))
            if self._window.peek(record.end, 4 + 47).find(b"op=\x04") < 0:
                pieces[-1] = self._by_messages(pieces[-1])
        elif record.op == Op.INDEX and pieces and pieces[-1].stop == record.at:
            pieces[-1] = self._extended(pieces[-1], record)
        elif record.op == Op.CONNECTION:
            key = number(record.header, b"conn", 4)
            data = self._source.read(record.begin, record.end - record.begin)
            self._index.connections.setdefault(key, connection_of(record, data))
        elif record.op == Op.MESSAGE:
            key, time_ns = number(record.header, b"conn", 4), time_of(record.header, b"time")
            self._loose(record, key, time_ns)

    def _loose(self, record: Record, key: int, time_ns: int) -> None:
        """Add a message outside chunks to the run of them that it continues."""
        pieces = self._index.pieces
        run = pieces[-1] if pieces else None
        if run is None or run.is_chunk or run.stop != record.at or record.end - run.offset > _RUN_BYTES:
            pieces.append(Piece(record.at, record.end, time_ns, time_ns, {key: 1}, is_chunk=False))
            return
        run.counts[key] = run.counts.get(key, 0) + 1
        first, last = min(run.start_ns, time_ns), max(run.end_ns, time_ns)
        pieces[-1] = replace(run, stop=record.end, start_ns=first, end_ns=last)

    def _extended(self, piece: Piece, record: Record) -> Piece:
        """Return the chunk with one more of its index records; it may name connections only the chunk describes."""
        data = self._source.read(record.begin, record.end - record.begin)
        whole = Record(record.op, record.header, 0, 0, len(data))
        key, entries = index_entries(whole, data)
        if key not in self._index.connections:
            self._by_messages(piece)
        times = times_of(entries)
        if not len(times):
            return replace(piece, stop=record.end)
        first, last = int(times.min()), int(times.max())
        if piece.counts:
            first, last = min(first, piece.start_ns), max(last, piece.end_ns)
        counts = {**piece.counts, key: len(times)}
        return replace(piece, stop=record.end, start_ns=first, end_ns=last, counts=counts)

    def _by_messages(self, piece: Piece) -> Piece:
        """Return the chunk with times and counts from its messages, as far as they can be read."""
        counts: dict[int, int] = {}
        first, last = 0, 0
        raw = self._source.read(piece.offset, piece.stop - piece.offset)
        try:
            head = chunk_head(raw)
            data = inflate_some(memoryview(raw)[head.begin : head.end], head.compression, head.size)
            for message in messages_in(data, self._index.connections):
                first = min(first, message.time_ns) if counts else message.time_ns
                last = max(last, message.time_ns)
                counts[message.connection] = counts.get(message.connection, 0) + 1
        except BagError:
            pass  # reading the chunk will say what is wrong with it
        return replace(piece, start_ns=first, end_ns=last, counts=counts)

    def _stray(self, at: int, stop: int, reason: str) -> None:
        piece = self._by_messages(Piece(at, stop, 0, 0, {}, is_cut=True))
        if piece.counts:
            self._index.pieces.append(piece)
        else:
            self._index.unreadable.append(UnreadableRange(at, f"{reason}; {stop - at} bytes are not read"))
