"""This file reads ROS 1 bags: messages are found through the index records, as arrays, or record by record."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from functools import partial

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.blocks import (
    Block,
    Bytes,
    Encoding,
    Loaded,
    Slab,
    Stream,
    UnreadableRange,
    Want,
    by_key,
    in_groups,
    keep,
    keep_each,
    orphans,
    stretches,
)
from mosaico_ingest.rosbag.compression import Packed, inflate_all, inflate_some
from mosaico_ingest.rosbag.definitions.model import Embedded
from mosaico_ingest.rosbag.ros1.index import Piece, Ros1Index, read_index
from mosaico_ingest.rosbag.ros1.records import (
    ChunkHead,
    Op,
    chunk_head,
    index_entries,
    messages_in,
    number,
    records_in,
    time_of,
    times_of,
)
from mosaico_ingest.rosbag.source import Source, Stretches

__all__ = ["Ros1Part"]

_LAYOUTS = 4
"""How many different layouts of message headers a connection may have before chunks are read record by record."""
_CHUNKS = 16
"""How many chunks are read at once: only they themselves know to what size they inflate."""


class _Chunk(Struct, frozen=True):
    """A piece as it was read: its data, and the index records behind it."""

    piece: Piece
    after: memoryview
    records: Bytes
    """What all chunks that were read together hold."""
    begin: int
    end: int

    @property
    def is_indexed(self) -> bool:
        """Whether index records say where its messages are."""
        return self.piece.is_chunk and not self.piece.is_cut

    @property
    def data(self) -> Bytes:
        """What this one holds."""
        return self.records[self.begin : self.end]


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
        self.unreadable: list[UnreadableRange] = [
            *self._index.unreadable,
            *orphans(counts, self._index.connections),
        ]
        self.notes: list[str] = source.notes

    def blocks(self, want: Want) -> Iterator[Block]:
        """Yield the chunks that may hold wanted messages."""
        keys = frozenset(want.keys)
        wanted = [
            piece
            for piece in self._pieces
            if piece.is_cut or (want.overlaps(piece.start_ns, piece.end_ns) and piece.counts.keys() & keys)
        ]
        self._source.prefetch((piece.offset, piece.stop) for piece in wanted)
        for group in in_groups(wanted, _packed_bytes, want.block_bytes, most=_CHUNKS):
            yield Block(group[0].start_ns, partial(self._load, group, want))

    def check_unchanged(self) -> None:
        """See `Source.check_unchanged`."""
        self._source.check_unchanged()

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    def _load(self, pieces: Sequence[Piece], want: Want) -> Loaded:
        loaded = Loaded([], [])
        chunks = self._chunks(pieces, want, loaded)
        indexed = [chunk for chunk in chunks if chunk.is_indexed]
        if indexed:
            _by_index(indexed, want, loaded)
        for chunk in chunks:
            if not chunk.is_indexed:
                _scan(chunk, want, loaded)
        return loaded

    def _chunks(self, pieces: Sequence[Piece], want: Want, loaded: Loaded) -> list[_Chunk]:
        """Read and inflate; what is whole lies in one buffer, what is broken is among the unreadable."""
        found: list[_Chunk] = []
        packed: list[tuple[Piece, memoryview, Packed]] = []
        stretches = Stretches(self._source, ((piece.offset, piece.stop) for piece in pieces))
        for piece in pieces:
            try:
                at = stretches.read(piece.offset, piece.stop)
                raw = stretches.data[at].data
                head = _head(raw, piece) if piece.is_chunk else None
                if head is None or piece.is_cut:
                    found.append(_whole(piece, raw if head is None else _cut(raw, head, piece, loaded)))
                else:
                    where = Packed(at.start + head.begin, at.start + head.end, head.compression, head.size)
                    packed.append((piece, raw[head.end :], where))
            except BagError as err:  # noqa: PERF203 - each chunk may fail for itself
                loaded.unreadable.extend(_broken(piece, want, err))
        inflated = inflate_all(stretches.data, [where for *_, where in packed])
        for place, (piece, after, _) in enumerate(packed):
            if place in inflated.failures:
                loaded.unreadable.extend(_broken(piece, want, inflated.failures[place]))
            else:
                found.append(_Chunk(piece, after, inflated.data, *inflated.places[place]))
        return found


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


def _packed_bytes(piece: Piece) -> int:
    return piece.stop - piece.offset


def _whole(piece: Piece, data: memoryview) -> _Chunk:
    return _Chunk(piece, memoryview(b""), np.frombuffer(data, np.uint8), 0, len(data))


def _head(raw: memoryview, piece: Piece) -> ChunkHead:
    head = chunk_head(raw)
    if head.end > len(raw) and not piece.is_cut:
        raise BagError(f"{head.end - head.begin} bytes announced, {len(raw) - head.begin} left")
    return head


def _cut(raw: memoryview, head: ChunkHead, piece: Piece, loaded: Loaded) -> memoryview:
    data = inflate_some(raw[head.begin : head.end], head.compression, head.size)
    reason = f"this chunk is cut off; {len(data)} of its {head.size} bytes could be read"
    loaded.unreadable.append(UnreadableRange(piece.offset, reason))
    return memoryview(data)


def _broken(piece: Piece, want: Want, err: BagError) -> Iterator[UnreadableRange]:
    for key in piece.counts.keys() & want.keys:
        yield UnreadableRange(
            piece.offset, f"broken chunk: {err.what}", connection=key, count=piece.counts[key]
        )


def _by_index(chunks: Sequence[_Chunk], want: Want, loaded: Loaded) -> None:
    """Add the wanted messages that the index records name; a chunk whose index is wrong is scanned."""
    try:
        slabs = _indexed(chunks, want.keys)
    except BagError as err:
        if len(chunks) > 1:
            for chunk in chunks:
                _by_index([chunk], want, loaded)
            return
        reason = f"{err.what}; the chunk was read record by record"
        loaded.unreadable.append(UnreadableRange(chunks[0].piece.offset, reason, count=0))
        _scan(chunks[0], want, loaded)
        return
    for slab in slabs:
        keep(slab, want, loaded)


def _indexed(chunks: Sequence[_Chunk], keys: Collection[int]) -> list[Slab]:
    """Return the wanted messages that the index records behind all these chunks name.

    Raises:
        BagError: The index does not agree with the records.
    """
    records = chunks[0].records
    begins = np.array([chunk.begin for chunk in chunks], np.int64)
    ends = np.array([chunk.end for chunk in chunks], np.int64)
    places = np.array([chunk.piece.offset for chunk in chunks], np.int64)
    named: dict[int, list[tuple[int, NDArray[np.void]]]] = {}
    for owner, chunk in enumerate(chunks):
        for key, entries in _indexes(chunk, keys).items():
            named.setdefault(key, []).append((owner, entries))
    slabs: list[Slab] = []
    for key, found in named.items():
        owners = np.repeat([owner for owner, _ in found], [len(entries) for _, entries in found])
        entries = np.concatenate([entries for _, entries in found])
        at, times = begins[owners] + entries["offset"].astype(np.int64), times_of(entries)
        starts, lengths = _located(records, key, at, times, ends[owners])
        slabs.append(Slab(key, times, records, starts, lengths, places[owners]))
    return slabs


def _indexes(chunk: _Chunk, wanted: Collection[int]) -> dict[int, NDArray[np.void]]:
    """Return the entries of the wanted connections.

    Raises:
        BagError: Some are missing, or are not as many as promised.
    """
    counts = chunk.piece.counts
    keys = {key for key, count in counts.items() if count and key in wanted}
    found: dict[int, NDArray[np.void]] = {}
    for record in records_in(chunk.after) if keys else ():
        if record.op == Op.INDEX:
            key, entries = index_entries(record, chunk.after)
            if key in keys and len(entries) == counts[key]:
                found[key] = entries
            if found.keys() == keys:
                break
    if found.keys() != keys:
        raise BagError("an index record is missing")
    return found


def _located(
    records: Bytes, key: int, at: NDArray[np.int64], times: NDArray[np.int64], ends: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return where the payloads of messages begin and how long they are; those with like headers go together.

    Raises:
        BagError: The index does not agree with the records.
    """
    starts, lengths = np.empty_like(at), np.empty_like(at)
    left = np.arange(len(at))
    for _ in range(_LAYOUTS):
        if not len(left):
            return starts, lengths
        first = left[0]
        layout = _layout(records[at[first] : ends[first]])
        alike, starts[left], lengths[left] = _alike(
            records, layout, key, at[left], times[left], ends=ends[left]
        )
        if not alike[0]:
            break
        left = left[~alike]
    raise BagError("an index record does not point at its messages")


def _alike(
    records: Bytes,
    layout: _Layout,
    key: int,
    at: NDArray[np.int64],
    times: NDArray[np.int64],
    *,
    ends: NDArray[np.int64],
) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
    """Return which messages have this layout and are what the index says, their payloads' starts and lengths.

    Raises:
        BagError: One would lie outside its chunk.
    """
    begin = at + layout.skipped
    if bool((begin > ends - layout.size).any()):
        raise BagError("an index record points outside its chunk")
    heads = stretches(records, begin, layout.size)
    alike = (heads[:, layout.fixed] == heads[0, layout.fixed]).all(axis=1)
    stamps = _words(heads, layout.time_at, 2).astype(np.int64)
    lengths = _words(heads, layout.size - 4, 1).astype(np.int64).reshape(-1)
    alike &= _words(heads, layout.conn_at, 1).reshape(-1) == key
    alike &= stamps[:, 0] * 1_000_000_000 + stamps[:, 1] == times
    alike &= begin + layout.size + lengths <= ends
    return alike, begin + layout.size, lengths


def _words(heads: Bytes, at: int, count: int) -> NDArray[np.uint32]:
    return np.ascontiguousarray(heads[:, at : at + 4 * count]).view("<u4")


class _Layout(Struct, frozen=True):
    """How a message record begins: what lies where before its payload."""

    skipped: int
    """Bytes of connection records between where the index points and the message."""
    size: int
    fixed: NDArray[np.bool_]
    """Which of the bytes are the same in every message of this layout."""
    conn_at: int
    time_at: int


def _layout(data: Bytes) -> _Layout:
    """Return the layout of the message that `data` begins with, maybe behind connection records.

    Raises:
        BagError: None is there.
    """
    skipped = 0
    for record in records_in(data.data):
        if record.op == Op.MESSAGE:
            break
        skipped = record.end
    else:
        raise BagError("an index record points at no message")
    number(record.header, b"conn", 4)
    time_of(record.header, b"time")
    head = data[record.at : record.begin].tobytes()
    conn_at, time_at = head.find(b"conn=") + 5, head.find(b"time=") + 5
    fixed = np.ones(len(head), np.bool_)
    for begin, size in ((conn_at, 4), (time_at, 8), (len(head) - 4, 4)):
        fixed[begin : begin + size] = False
    return _Layout(skipped, len(head), fixed, conn_at, time_at)


def _scan(chunk: _Chunk, want: Want, loaded: Loaded) -> None:
    """Add the wanted messages record by record, up to the first that does not fit."""
    piece, records = chunk.piece, chunk.data
    found: list[tuple[int, int, int, int, int]] = []
    try:
        for message in messages_in(records.data):
            found.append((message.connection, message.time_ns, message.begin, message.end, message.at))  # noqa: PERF401 - what came before an error counts
    except BagError as err:
        loaded.unreadable.append(UnreadableRange(piece.offset, f"{err.what}; the rest is not read"))
    columns = np.array(found, np.int64).reshape(-1, 5)
    keys, times, begins, ends, ats = columns.T
    offsets = np.full(len(ats), piece.offset, np.int64) if piece.is_chunk else ats + piece.offset
    wanted = [(key, rows) for key, rows in by_key(keys) if key in want.keys]
    keep_each(Slab(-1, times, records, begins, ends - begins, offsets), wanted, want, loaded)
