"""This file reads MCAP: messages are found through the message indexes, as arrays, or record by record."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator, Sequence
from functools import partial
from itertools import pairwise
from operator import itemgetter

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.blocks import (
    EARLIEST_NS,
    LATEST_NS,
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
    keep_each,
    orphans,
    stretches,
)
from mosaico_ingest.rosbag.compression import Packed, inflate_all, inflate_some
from mosaico_ingest.rosbag.definitions.model import Embedded
from mosaico_ingest.rosbag.mcap.index import (
    McapIndex,
    Piece,
    read_index,
    read_pieces,
)
from mosaico_ingest.rosbag.mcap.records import (
    RECORD,
    ChunkHead,
    McapChannel,
    Op,
    Schema,
    chunk_head,
)
from mosaico_ingest.rosbag.source import Source, Stretches

__all__ = ["McapPart"]

_ENCODINGS = {"cdr": Encoding.CDR, "ros1": Encoding.ROS1}
_ENTRY = np.dtype([("time", "<i8"), ("offset", "<u8")])
_HEAD = np.dtype(
    [
        ("op", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("time", "<i8"),
        ("published", "<i8"),
    ]
)
_FIXED_BYTES = _HEAD.itemsize - RECORD.size
"""How much of a message record's length is not payload."""


class _Chunk(Struct, frozen=True):
    """A piece as it was read, and its data."""

    piece: Piece
    raw: memoryview
    records: Bytes
    """What all chunks that were read together hold."""
    begin: int
    end: int

    @property
    def data(self) -> Bytes:
        """What this one holds."""
        return self.records[self.begin : self.end]


class McapPart:
    """One MCAP file, with or without summary, indexes, chunks, profile or end."""

    container = "mcap"

    def __init__(self, source: Source) -> None:
        self.path = source.path
        self._source = source
        try:
            self._index = read_index(self._source)
        except BaseException:
            self._source.close()
            raise
        index = self._index
        self.streams: tuple[Stream, ...] = tuple(
            _stream(key, channel, index) for key, channel in sorted(index.channels.items())
        )
        self.start_ns: int | None = index.start_ns
        self.end_ns: int | None = index.end_ns
        self.message_count: int | None = sum(index.counts.values()) if index.counts is not None else None
        self.unreadable: list[UnreadableRange] = [*index.unreadable, *orphans(index.counts, index.channels)]
        self.notes: list[str] = source.notes
        self._pieces: tuple[list[Piece], list[UnreadableRange]] | None = None

    def blocks(self, want: Want) -> Iterator[Block]:
        """Yield the chunks, and the stretches between chunks, that may hold wanted messages."""
        if self._pieces is None:
            self._pieces = read_pieces(self._source, self._index)
        pieces, unreadable = self._pieces
        if unreadable:
            yield Block(EARLIEST_NS, lambda: Loaded([], list(unreadable)))
        wanted = [
            piece
            for piece in pieces
            if want.overlaps(piece.start_ns, piece.end_ns) and piece.has_any(want.keys)
        ]
        self._source.prefetch((piece.offset, piece.stop) for piece in wanted)
        for group in in_groups(wanted, _inflated_bytes, want.block_bytes):
            yield Block(min(group[0].start_ns, LATEST_NS), partial(self._load, group, want))

    def check_unchanged(self) -> None:
        """See `Source.check_unchanged`."""
        self._source.check_unchanged()

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    def _load(self, pieces: Sequence[Piece], want: Want) -> Loaded:
        loaded = Loaded([], [])
        chunks = self._chunks(pieces, want, loaded)
        indexed = [chunk for chunk in chunks if chunk.piece.indexes]
        if indexed:
            self._by_index(indexed, want, loaded)
        for chunk in chunks:
            if not chunk.piece.indexes:
                self._scan(chunk, want, loaded)
        return loaded

    def _chunks(self, pieces: Sequence[Piece], want: Want, loaded: Loaded) -> list[_Chunk]:
        """Read and inflate; what is whole lies in one buffer, what is broken is among the unreadable."""
        found: list[_Chunk] = []
        packed: list[tuple[Piece, memoryview, ChunkHead, Packed]] = []
        stretches = Stretches(self._source, ((piece.offset, piece.stop) for piece in pieces))
        for piece in pieces:
            raw = memoryview(b"")
            try:
                at = stretches.read(piece.offset, piece.stop)
                raw = stretches.data[at].data
                head = chunk_head(raw) if piece.is_chunk else None
                if head is None or piece.is_cut:
                    found.append(_whole(piece, raw if head is None else _cut(raw, head, piece, loaded)))
                else:
                    end = at.start + min(head.end, len(raw))
                    where = Packed(at.start + head.begin, end, head.compression, head.size)
                    packed.append((piece, raw, head, where))
            except BagError as err:
                loaded.unreadable.extend(_whole_chunk(piece, raw, want, err))
        inflated = inflate_all(stretches.data, [where for *_, where in packed])
        for place, (piece, raw, head, _) in enumerate(packed):
            chunk = _Chunk(piece, raw, inflated.data, *inflated.places[place])
            broken = inflated.failures.get(place) or _wrong_checksum(chunk.data, head)
            if broken:
                loaded.unreadable.extend(_whole_chunk(piece, raw, want, broken))
            else:
                found.append(chunk)
        return found

    def _by_index(self, chunks: Sequence[_Chunk], want: Want, loaded: Loaded) -> None:
        """Add the wanted messages that the message indexes name; a chunk whose index is wrong is scanned."""
        try:
            keep_each(*_indexed(chunks, want.keys), want, loaded)
        except BagError as err:
            if len(chunks) > 1:
                for chunk in chunks:
                    self._by_index([chunk], want, loaded)
                return
            reason = f"{err.what}; the chunk was read record by record"
            loaded.unreadable.append(UnreadableRange(chunks[0].piece.offset, reason, count=0))
            self._scan(chunks[0], want, loaded)

    def _scan(self, chunk: _Chunk, want: Want, loaded: Loaded) -> None:
        """Add the wanted messages record by record, up to the first that does not fit."""
        piece = chunk.piece
        starts = _message_starts(chunk.data.data, piece, loaded)
        records = chunk.data
        heads = _heads(records, starts)
        found = list(by_key(heads["channel"]))
        wanted = [(key, rows) for key, rows in found if key in want.keys]
        offsets = np.full(len(starts), piece.offset, np.int64) if piece.is_chunk else starts + piece.offset
        keep_each(_slab(records, heads, starts, offsets), wanted, want, loaded)
        if self._index.counts is None:
            unwanted = {key: len(rows) for key, rows in found if key not in want.keys}
            loaded.unreadable.extend(orphans(unwanted, self._index.channels))


def _inflated_bytes(piece: Piece) -> int:
    return max(piece.size, piece.stop - piece.offset)


def _stream(key: int, channel: McapChannel, index: McapIndex) -> Stream:
    schema = index.schemas.get(channel.schema, Schema("", "", ""))
    ros_version = 1 if channel.encoding == "ros1" or schema.encoding == "ros1msg" else 2
    counts = index.counts
    return Stream(
        key,
        channel.topic,
        schema.name,
        _ENCODINGS.get(channel.encoding, Encoding.OTHER),
        ros_version,
        Embedded(schema.encoding, schema.text) if schema.encoding else None,
        counts.get(key, 0) if counts is not None else None,
        latched=channel.metadata.get("latching") == "1",
        attributes={"encoding": channel.encoding, "schema_encoding": schema.encoding, **channel.metadata},
    )


def _whole(piece: Piece, data: memoryview) -> _Chunk:
    return _Chunk(piece, data, np.frombuffer(data, np.uint8), 0, len(data))


def _wrong_checksum(data: Bytes, head: ChunkHead) -> BagError | None:
    if not head.crc or (found := zlib.crc32(data.data)) == head.crc:
        return None
    return BagError(f"its checksum is {found:08x}, {head.crc:08x} expected")


def _cut(raw: memoryview, head: ChunkHead, piece: Piece, loaded: Loaded) -> memoryview:
    data = inflate_some(raw[head.begin : head.end], head.compression, head.size)
    reason = f"this chunk is cut off; {len(data)} of its {head.size} bytes could be read"
    loaded.unreadable.append(UnreadableRange(piece.offset, reason))
    return memoryview(data)


def _whole_chunk(piece: Piece, raw: memoryview, want: Want, err: BagError) -> Iterator[UnreadableRange]:
    """Yield the unreadable_range of a chunk, by channel where its index says how many messages each had."""
    reason = f"broken chunk: {err.what}"
    if not piece.indexes:
        yield UnreadableRange(piece.offset, reason)
    for key, offset in piece.index_offsets():
        if key in want.keys:
            try:
                count: int | None = len(_entries(raw, piece, key, offset)) // _ENTRY.itemsize
            except BagError:
                count = None
            yield UnreadableRange(piece.offset, reason, connection=key, count=count)


def _entries(raw: memoryview, piece: Piece, key: int, offset: int) -> memoryview:
    """Return the entries of one message index record, as they stand there.

    Raises:
        BagError: It is not there, or is another's.
    """
    at = offset - piece.offset
    if not 0 <= at <= len(raw) - RECORD.size - 6:
        raise BagError(f"the message index of channel {key} lies at {offset}, outside its chunk's stretch")
    op, _, channel, size = struct.unpack_from("<BQHI", raw, at)
    begin = at + RECORD.size + 6
    if op != Op.MESSAGE_INDEX or channel != key or size % _ENTRY.itemsize or begin + size > len(raw):
        raise BagError(f"no message index of channel {key} at {offset}")
    return raw[begin : begin + size]


def _indexed(chunks: Sequence[_Chunk], keys: Collection[int]) -> tuple[Slab, list[tuple[int, slice]]]:
    """Return the wanted messages that the indexes of all these chunks name, and which of them are of which channel.

    Raises:
        BagError: An index record is not there, or an entry does not agree with its record.
    """
    named = [
        (key, number, _entries(chunk.raw, chunk.piece, key, offset))
        for number, chunk in enumerate(chunks)
        for key, offset in chunk.piece.index_offsets()
        if key in keys
    ]
    named.sort(key=itemgetter(0))
    counts = [len(entries) // _ENTRY.itemsize for _, _, entries in named]
    entries = np.frombuffer(b"".join(entries for _, _, entries in named), _ENTRY)
    channels = np.repeat(np.array([key for key, _, _ in named], np.uint16), counts)
    owners = np.repeat(np.array([number for _, number, _ in named], np.int64), counts)
    slab = _checked(chunks, entries, channels, owners)
    edges = np.flatnonzero(np.diff(channels.astype(np.int64), prepend=-1, append=-1)).tolist()
    return slab, [(int(channels[begin]), slice(begin, end)) for begin, end in pairwise(edges)]


def _checked(
    chunks: Sequence[_Chunk],
    entries: NDArray[np.void],
    channels: NDArray[np.uint16],
    owners: NDArray[np.int64],
) -> Slab:
    """Return the messages of all these index entries, checked at once against the records in their chunks.

    Raises:
        BagError: An entry does not agree with its record.
    """
    records = chunks[0].records
    begins = np.array([chunk.begin for chunk in chunks], np.int64)[owners]
    ends = np.array([chunk.end for chunk in chunks], np.int64)[owners]
    room = ends - begins - _HEAD.itemsize
    if bool((room < 0).any()) or bool((entries["offset"] > room.astype(np.uint64)).any()):
        raise BagError("a message index points outside its chunk")
    starts = begins + entries["offset"].astype(np.int64)
    heads = _heads(records, starts)
    fits = (heads["op"] == Op.MESSAGE) & (heads["channel"] == channels) & (heads["time"] == entries["time"])
    if not bool((fits & _within(heads, starts, ends)).all()):
        raise BagError("a message index does not point at its messages")
    places = np.array([chunk.piece.offset for chunk in chunks], np.int64)[owners]
    return _slab(records, heads, starts, places)


def _message_starts(data: memoryview, piece: Piece, loaded: Loaded) -> NDArray[np.int64]:
    """Return where messages begin, up to the first record that does not fit."""
    found: list[int] = []
    at = 0
    while at < len(data):
        op, length = RECORD.unpack_from(data, at) if at + RECORD.size <= len(data) else (0, 0)
        end = at + RECORD.size + length
        if op == 0 or end > len(data):
            reason = f"no whole record at byte {at} of {len(data)}; the rest is not read"
            loaded.unreadable.append(UnreadableRange(piece.offset, reason))
            break
        if op == Op.MESSAGE and length >= _FIXED_BYTES:
            found.append(at)
        elif op == Op.MESSAGE:
            reason = f"a message record of {length} bytes at byte {at}, too few for its fields"
            loaded.unreadable.append(UnreadableRange(piece.offset, reason))
        at = end
    return np.array(found, np.int64)


def _heads(records: Bytes, starts: NDArray[np.int64]) -> NDArray[np.void]:
    if not len(starts):
        return np.empty(0, _HEAD)
    return stretches(records, starts, _HEAD.itemsize).view(_HEAD).reshape(-1)


def _within(heads: NDArray[np.void], starts: NDArray[np.int64], ends: NDArray[np.int64]) -> NDArray[np.bool_]:
    length = heads["length"]
    return (length >= _FIXED_BYTES) & (length <= (ends - RECORD.size - starts).astype(np.uint64))


def _slab(
    records: Bytes, heads: NDArray[np.void], starts: NDArray[np.int64], offsets: NDArray[np.int64]
) -> Slab:
    """Return messages, of any channel, whose records have been checked."""
    lengths = heads["length"].astype(np.int64) - _FIXED_BYTES
    return Slab(-1, np.ascontiguousarray(heads["time"]), records, starts + _HEAD.itemsize, lengths, offsets)
