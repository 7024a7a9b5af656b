"""This file reads ROS 1 bags: messages are found through the index records, as arrays, or record by record."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mosaico_ingest.bag.batch import Encoding
from mosaico_ingest.bag.containers.compression import inflate, inflate_some
from mosaico_ingest.bag.containers.part import Block, Hole, Loaded, Slab, Stream, Want, orphans
from mosaico_ingest.bag.containers.ros1_index import MAGIC, Piece, Ros1Index, read_index
from mosaico_ingest.bag.containers.ros1_records import (
    Op,
    chunk_head,
    index_entries,
    messages_in,
    number,
    records_in,
    time_of,
    times_of,
)
from mosaico_ingest.bag.containers.slab import Bytes, by_key, keep, keep_each, stretches
from mosaico_ingest.bag.containers.source import Source
from mosaico_ingest.bag.definition import Embedded
from mosaico_ingest.errors import BagError

__all__ = ["MAGIC", "Ros1Part"]

_LAYOUTS = 4
"""How many different layouts of message headers one chunk may have before it is read record by record."""


class Ros1Part:
    """One `.bag` file, closed properly or not."""

    container = "ros1"

    def __init__(self, source: Source) -> None:
        self.path = source.path
        self._source = source
        try:
            self._index = read_index(self._source)
        except BaseException:
            self._source.close()
            raise
        self._pieces = sorted(self._index.pieces, key=lambda piece: piece.start_ns)
        counts: dict[int, int] = {}
        for piece in self._index.pieces:
            for key, count in piece.counts.items():
                counts[key] = counts.get(key, 0) + count
        filled = [piece for piece in self._index.pieces if piece.counts]
        self.streams: tuple[Stream, ...] = _streams(self._index, counts)
        self.start_ns: int | None = min((piece.start_ns for piece in filled), default=None)
        self.end_ns: int | None = max((piece.end_ns for piece in filled), default=None)
        self.message_count: int | None = sum(counts.values())
        self.holes: list[Hole] = [*self._index.holes, *orphans(counts, self._index.connections)]
        self.notes: list[str] = source.notes

    def blocks(self, want: Want) -> Iterator[Block]:
        """Yield the chunks that may hold wanted messages."""
        keys = frozenset(want.keys)
        wanted = [
            piece
            for piece in self._pieces
            if piece.is_cut or (want.times(piece.start_ns, piece.end_ns) and piece.counts.keys() & keys)
        ]
        self._source.expect((piece.offset, piece.stop) for piece in wanted)
        for piece in wanted:
            yield Block(piece.start_ns, partial(self._load, piece, want))

    def confirm(self) -> None:
        """Say that all was read; see `Source.confirm`."""
        self._source.confirm()

    def close(self) -> None:
        """Let go of the file."""
        self._source.close()

    def _load(self, piece: Piece, want: Want) -> Loaded:
        loaded = Loaded([], [])
        try:
            raw = self._source.read(piece.offset, piece.stop - piece.offset)
            data, after = _chunk(raw, piece, loaded) if piece.is_chunk else (raw, len(raw))
        except BagError as err:
            for key in piece.counts.keys() & want.keys:
                reason = f"broken chunk: {err.what}"
                loaded.holes.append(Hole(piece.offset, reason, key=key, count=piece.counts[key]))
            return loaded
        is_indexed = piece.is_chunk and not piece.is_cut
        if not is_indexed or not _by_index(data, raw[after:], piece, want, loaded):
            _scan(data, piece, want, loaded)
        return loaded


def _streams(index: Ros1Index, counts: dict[int, int]) -> tuple[Stream, ...]:
    return tuple(
        Stream(
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


def _chunk(raw: bytes, piece: Piece, loaded: Loaded) -> tuple[bytes | memoryview, int]:
    """Return a chunk's data, and where its index records begin."""
    head = chunk_head(raw)
    packed = memoryview(raw)[head.begin : head.end]
    if piece.is_cut:
        data = inflate_some(packed, head.compression, head.size)
        reason = f"this chunk is cut off; {len(data)} of its {head.size} bytes could be read"
        loaded.holes.append(Hole(piece.offset, reason))
        return data, len(raw)
    if head.end > len(raw):
        raise BagError(f"{head.end - head.begin} bytes announced, {len(raw) - head.begin} left")
    return inflate(packed, head.compression, head.size), head.end


def _by_index(data: bytes | memoryview, after: bytes, piece: Piece, want: Want, loaded: Loaded) -> bool:
    """Add the wanted messages that the index records behind the chunk name; return whether they could be trusted."""
    keys = {key for key, count in piece.counts.items() if count and key in want.keys}
    records = np.frombuffer(data, np.uint8)
    try:
        found = _indexes(after, piece, keys)
        slabs = [_indexed(records, data, key, entries, piece) for key, entries in found.items()]
    except BagError as err:
        loaded.holes.append(Hole(piece.offset, f"{err.what}; the chunk was read record by record", count=0))
        return False
    for slab in slabs:
        keep(slab, want, loaded)
    return True


def _indexes(after: bytes, piece: Piece, keys: set[int]) -> dict[int, NDArray[np.void]]:
    """Return the entries of the wanted connections.

    Raises:
        BagError: Some are missing, or are not as many as promised.
    """
    found: dict[int, NDArray[np.void]] = {}
    for record in records_in(after) if keys else ():
        if record.op == Op.INDEX:
            key, entries = index_entries(record, after)
            if key in keys and len(entries) == piece.counts[key]:
                found[key] = entries
            if found.keys() == keys:
                break
    if found.keys() != keys:
        raise BagError("an index record is missing")
    return found


def _indexed(
    records: Bytes, data: bytes | memoryview, key: int, entries: NDArray[np.void], piece: Piece
) -> Slab:
    """Return the messages of one index record; those whose headers are laid out alike are checked together.

    Raises:
        BagError: The index does not agree with the records.
    """
    at, times = entries["offset"].astype(np.int64), times_of(entries)
    starts, lengths = np.empty_like(at), np.empty_like(at)
    left = np.arange(len(at))
    for _ in range(_LAYOUTS):
        if not len(left):
            return Slab(key, times, records, starts, lengths, np.full(len(at), piece.offset, np.int64))
        layout = _layout(data, int(at[left[0]]))
        alike, starts[left], lengths[left] = _alike(records, layout, key, at[left], times[left])
        if not alike[0]:
            break
        left = left[~alike]
    raise BagError("an index record does not point at its messages")


def _alike(
    records: Bytes, layout: _Layout, key: int, at: NDArray[np.int64], times: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
    """Return which messages have this layout and are what the index says, their payloads' starts and lengths.

    Raises:
        BagError: One would lie outside the chunk.
    """
    begin = at + layout.skipped
    if int(begin.max()) > len(records) - layout.size:
        raise BagError("an index record points outside its chunk")
    heads = stretches(records, begin, layout.size)
    alike = (heads[:, layout.fixed] == heads[0, layout.fixed]).all(axis=1)
    stamps = _words(heads, layout.time_at, 2).astype(np.int64)
    lengths = _words(heads, layout.size - 4, 1).astype(np.int64).reshape(-1)
    alike &= _words(heads, layout.conn_at, 1).reshape(-1) == key
    alike &= stamps[:, 0] * 1_000_000_000 + stamps[:, 1] == times
    alike &= begin + layout.size + lengths <= len(records)
    return alike, begin + layout.size, lengths


def _words(heads: Bytes, at: int, count: int) -> NDArray[np.uint32]:
    return np.ascontiguousarray(heads[:, at : at + 4 * count]).view("<u4")


@dataclass(frozen=True, slots=True)
class _Layout:
    """How a message record begins: what lies where before its payload."""

    skipped: int
    """Bytes of connection records between where the index points and the message."""
    size: int
    fixed: NDArray[np.bool_]
    """Which of the bytes are the same in every message of this layout."""
    conn_at: int
    time_at: int


def _layout(data: bytes | memoryview, at: int) -> _Layout:
    """Return the layout of the message at `at`.

    Raises:
        BagError: None is there.
    """
    skipped = 0
    for record in records_in(memoryview(data)[at:]):
        if record.op == Op.MESSAGE:
            break
        skipped = record.end
    else:
        raise BagError("an index record points at no message")
    number(record.header, b"conn", 4)
    time_of(record.header, b"time")
    head = bytes(data[at + record.at : at + record.begin])
    conn_at, time_at = head.find(b"conn=") + 5, head.find(b"time=") + 5
    fixed = np.ones(len(head), np.bool_)
    for begin, size in ((conn_at, 4), (time_at, 8), (len(head) - 4, 4)):
        fixed[begin : begin + size] = False
    return _Layout(skipped, len(head), fixed, conn_at, time_at)


def _scan(data: bytes | memoryview, piece: Piece, want: Want, loaded: Loaded) -> None:
    """Add the wanted messages record by record, up to the first that does not fit."""
    found: list[tuple[int, int, int, int, int]] = []
    try:
        for message in messages_in(data):
            found.append((message.connection, message.time_ns, message.begin, message.end, message.at))  # noqa: PERF401 - what came before an error counts
    except BagError as err:
        loaded.holes.append(Hole(piece.offset, f"{err.what}; the rest is not read"))
    columns = np.array(found, np.int64).reshape(-1, 5)
    keys, times, begins, ends, ats = columns.T
    offsets = np.full(len(ats), piece.offset, np.int64) if piece.is_chunk else ats + piece.offset
    records = np.frombuffer(data, np.uint8)
    wanted = [(key, rows) for key, rows in by_key(keys) if key in want.keys]
    keep_each(Slab(-1, times, records, begins, ends - begins, offsets), wanted, want, loaded)
