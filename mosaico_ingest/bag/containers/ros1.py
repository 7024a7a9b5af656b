"""This file reads ROS 1 bags: messages are found through the index records, as arrays, or record by record."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mosaico_ingest.bag.batch import Encoding
from mosaico_ingest.bag.containers.compression import inflate, inflate_some
from mosaico_ingest.bag.containers.part import LATEST_NS, Block, Hole, Loaded, Slab, Stream, Want
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
from mosaico_ingest.bag.containers.slab import by_key, stretches, wanted
from mosaico_ingest.bag.containers.source import FileSource
from mosaico_ingest.bag.definition import Embedded
from mosaico_ingest.errors import BagError

__all__ = ["MAGIC", "Ros1Part"]

_LAYOUTS = 4
"""How many different layouts of message headers one chunk may have before it is read record by record."""


class Ros1Part:
    """One `.bag` file, closed properly or not."""

    container = "ros1"

    def __init__(self, path: Path, name: Path | None = None) -> None:
        self.path = name or path
        self._source = FileSource(path, name)
        try:
            self._index = read_index(self._source)
        except BaseException:
            self._source.close()
            raise
        counts: dict[int, int] = {}
        for piece in self._index.pieces:
            for key, count in piece.counts.items():
                counts[key] = counts.get(key, 0) + count
        filled = [piece for piece in self._index.pieces if piece.counts]
        self.streams: tuple[Stream, ...] = _streams(self._index, counts)
        self.start_ns: int | None = min((piece.start_ns for piece in filled), default=None)
        self.end_ns: int | None = max((piece.end_ns for piece in filled), default=None)
        self.message_count: int | None = sum(counts.values())
        self.holes: list[Hole] = self._index.holes
        self.notes: list[str] = []

    def blocks(self, want: Want) -> Iterator[Block]:
        """Yield the chunks that may hold wanted messages."""
        keys = frozenset(want.keys)
        for piece in sorted(self._index.pieces, key=lambda piece: piece.start_ns):
            if piece.is_cut or (want.times(piece.start_ns, piece.end_ns) and piece.counts.keys() & keys):
                yield Block(piece.start_ns, partial(self._load, piece, want))

    def close(self) -> None:
        """Let go of the file."""
        self._source.close()

    def _load(self, piece: Piece, want: Want) -> Loaded:
        raw = self._source.read(piece.offset, piece.stop - piece.offset)
        loaded = Loaded([], [])
        if not piece.is_chunk:
            _scan(raw, piece.offset, want, loaded, where=piece.offset)
            return loaded
        try:
            data, after = _chunk(raw, piece, loaded)
        except BagError as err:
            for key in piece.counts.keys() & want.keys:
                reason = f"broken chunk: {err.what}"
                loaded.holes.append(Hole(piece.offset, reason, key=key, count=piece.counts[key]))
            return loaded
        if not piece.is_cut:
            try:
                _by_index(np.frombuffer(data, np.uint8), raw[after:], piece, want, loaded)
            except BagError as err:
                reason = f"{err.what}; the chunk was read record by record"
                loaded.holes.append(Hole(piece.offset, reason, count=0))
            else:
                return loaded
        _scan(data, piece.offset, want, loaded)
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
        reason = f"the file ends within this chunk; {len(data)} of its {head.size} bytes could be read"
        loaded.holes.append(Hole(piece.offset, reason))
        return data, len(raw)
    if head.end > len(raw):
        raise BagError(f"{head.end - head.begin} bytes announced, {len(raw) - head.begin} left")
    return inflate(packed, head.compression, head.size), head.end


def _by_index(records: NDArray[np.uint8], after: bytes, piece: Piece, want: Want, loaded: Loaded) -> None:
    """Add the wanted messages that the index records behind the chunk name.

    Raises:
        BagError: There is no index for them, or it does not agree with the records.
    """
    found: dict[int, NDArray[np.void]] = {}
    missing = {key for key in piece.counts.keys() & want.keys if piece.counts[key]}
    if not missing:
        return
    for record in records_in(after):
        if record.op != Op.INDEX:
            continue
        key, entries = index_entries(record, after)
        if key in missing and len(entries) == piece.counts[key]:
            found[key] = entries
        if found.keys() >= missing:
            break
    if found.keys() != missing:
        raise BagError("an index record is missing")
    slabs = [_indexed(records, key, entries, piece.offset) for key, entries in found.items()]
    for slab in slabs:
        _keep(slab, want, loaded)


def _indexed(records: NDArray[np.uint8], key: int, entries: NDArray[np.void], offset: int) -> Slab:
    """Return the messages of one index record; those whose headers are laid out alike are checked together."""
    at = entries["offset"].astype(np.int64)
    times = times_of(entries)
    starts, lengths = np.empty_like(at), np.empty_like(at)
    left = np.arange(len(at))
    memory = memoryview(records)
    for _ in range(_LAYOUTS):
        if not len(left):
            return Slab(key, times, records, starts, lengths, np.full(len(at), offset, np.int64))
        alike = _alike(records, memory, key, at[left], times[left], starts, lengths, left)
        left = left[~alike]
    raise BagError("an index record does not point at its messages")


def _alike(
    records: NDArray[np.uint8],
    memory: memoryview,
    key: int,
    at: NDArray[np.int64],
    times: NDArray[np.int64],
    starts: NDArray[np.int64],
    lengths: NDArray[np.int64],
    rows: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """Fill in the messages whose headers look like the first one's; return which they are.

    Raises:
        BagError: The first is not the message that the index names.
    """
    skipped, size, fixed, conn_at, time_at = _layout(memory, int(at[0]))
    begin = at + skipped
    if int(begin.max()) > len(records) - size:
        raise BagError("an index record points outside its chunk")
    heads = stretches(records, begin, size)
    alike = (heads[:, fixed] == heads[0, fixed]).all(axis=1)
    conns = np.ascontiguousarray(heads[:, conn_at : conn_at + 4]).view("<u4").reshape(-1)
    stamps = np.ascontiguousarray(heads[:, time_at : time_at + 8]).view("<u4").astype(np.int64)
    sizes = np.ascontiguousarray(heads[:, -4:]).view("<u4").reshape(-1).astype(np.int64)
    alike &= (conns == key) & (stamps[:, 0] * 1_000_000_000 + stamps[:, 1] == times)
    alike &= begin + size + sizes <= len(records)
    if not alike[0]:
        raise BagError("an index record does not point at its messages")
    starts[rows[alike]] = begin[alike] + size
    lengths[rows[alike]] = sizes[alike]
    return alike


def _layout(data: memoryview, at: int) -> tuple[int, int, NDArray[np.bool_], int, int]:
    """Return how far behind `at` the message begins, the bytes before its payload, and where in them what is."""
    skipped = 0
    for record in records_in(data[at:]):
        if record.op == Op.MESSAGE:
            break
        skipped = record.end
    else:
        raise BagError("an index record points at no message")
    size = record.begin - record.at
    head = bytes(data[at + record.at : at + record.begin])
    conn_at, time_at = head.find(b"conn=") + 5, head.find(b"time=") + 5
    fixed = np.ones(size, np.bool_)
    fixed[conn_at : conn_at + 4] = False
    fixed[time_at : time_at + 8] = False
    fixed[-4:] = False
    number(record.header, b"conn", 4)
    time_of(record.header, b"time")
    return skipped, size, fixed, conn_at, time_at


def _scan(
    data: bytes | memoryview, offset: int, want: Want, loaded: Loaded, *, where: int | None = None
) -> None:
    """Add the wanted messages record by record, up to the first that does not fit."""
    found: list[tuple[int, int, int, int, int]] = []
    try:
        for message in messages_in(data):
            if message.connection in want.keys and message.time_ns <= LATEST_NS:
                found.append((message.connection, message.time_ns, message.begin, message.end, message.at))
    except BagError as err:
        loaded.holes.append(Hole(offset, f"{err.what}; the rest is not read"))
    columns = np.array(found, np.int64).reshape(-1, 5)
    keys, times, begins, ends, ats = columns.T
    offsets = np.full(len(ats), offset, np.int64) if where is None else ats + where
    slab = Slab(0, times, np.frombuffer(data, np.uint8), begins, ends - begins, offsets)
    for key, rows in by_key(keys, want.keys):
        part = slab.rows(rows)
        _keep(Slab(key, part.log_times, part.data, part.starts, part.lengths, part.offsets), want, loaded)


def _keep(slab: Slab, want: Want, loaded: Loaded) -> None:
    slab = wanted(slab, want, loaded.holes)
    if len(slab):
        loaded.slabs.append(slab)
