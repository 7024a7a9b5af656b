"""This file reads MCAP: messages are found through the message indexes, as arrays, or record by record."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mosaico_ingest.bag.batch import Encoding
from mosaico_ingest.bag.containers.compression import inflate, inflate_some
from mosaico_ingest.bag.containers.mcap_index import McapIndex, Piece, read_index, read_pieces
from mosaico_ingest.bag.containers.mcap_records import (
    MAGIC,
    RECORD,
    ChunkHead,
    McapChannel,
    Op,
    Schema,
    chunk_head,
)
from mosaico_ingest.bag.containers.part import (
    EARLIEST_NS,
    LATEST_NS,
    Block,
    Hole,
    Loaded,
    Slab,
    Stream,
    Want,
    orphans,
)
from mosaico_ingest.bag.containers.slab import Bytes, by_key, keep_each, stretches
from mosaico_ingest.bag.containers.source import Source
from mosaico_ingest.bag.definition import Embedded
from mosaico_ingest.errors import BagError

__all__ = ["MAGIC", "McapPart"]

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
        self.holes: list[Hole] = [*index.holes, *orphans(index.counts, index.channels)]
        self.notes: list[str] = source.notes
        self._pieces: tuple[list[Piece], list[Hole]] | None = None

    def blocks(self, want: Want) -> Iterator[Block]:
        """Yield the chunks, and the stretches between chunks, that may hold wanted messages."""
        if self._pieces is None:
            self._pieces = read_pieces(self._source, self._index)
        pieces, holes = self._pieces
        if holes:
            yield Block(EARLIEST_NS, lambda: Loaded([], list(holes)))
        wanted = [
            piece for piece in pieces if want.times(piece.start_ns, piece.end_ns) and piece.has_any(want.keys)
        ]
        self._source.expect((piece.offset, piece.stop) for piece in wanted)
        for piece in wanted:
            yield Block(min(piece.start_ns, LATEST_NS), partial(self._load, piece, want))

    def confirm(self) -> None:
        """Say that all was read; see `Source.confirm`."""
        self._source.confirm()

    def close(self) -> None:
        """Let go of the file."""
        self._source.close()

    def _load(self, piece: Piece, want: Want) -> Loaded:
        raw = self._source.read(piece.offset, piece.stop - piece.offset)
        loaded = Loaded([], [])
        if not piece.is_chunk:
            self._scan(raw, piece, want, loaded)
            return loaded
        try:
            head = chunk_head(raw)
            data = _cut_chunk(raw, head, piece, loaded) if piece.is_cut else _chunk(raw, head)
        except BagError as err:
            loaded.holes.extend(_whole_chunk(piece, raw, want, f"broken chunk: {err.what}"))
            return loaded
        if not piece.indexes or not _by_index(data, raw, piece, want, loaded):
            self._scan(data, piece, want, loaded)
        return loaded

    def _scan(self, data: bytes | memoryview, piece: Piece, want: Want, loaded: Loaded) -> None:
        """Add the wanted messages record by record, up to the first that does not fit."""
        starts = _message_starts(data, piece, loaded)
        records = np.frombuffer(data, np.uint8)
        heads = _heads(records, starts)
        found = list(by_key(heads["channel"]))
        wanted = [(key, rows) for key, rows in found if key in want.keys]
        keep_each(_slab(records, heads, starts, piece), wanted, want, loaded)
        if self._index.counts is None:
            unwanted = {key: len(rows) for key, rows in found if key not in want.keys}
            loaded.holes.extend(orphans(unwanted, self._index.channels))


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


def _chunk(raw: bytes, head: ChunkHead) -> bytes | memoryview:
    if head.end > len(raw):
        raise BagError(f"{head.end - head.begin} bytes announced, {len(raw) - head.begin} left")
    data = inflate(memoryview(raw)[head.begin : head.end], head.compression, head.size)
    if head.crc and zlib.crc32(data) != head.crc:
        raise BagError(f"its checksum is {zlib.crc32(data):08x}, {head.crc:08x} expected")
    return data


def _cut_chunk(raw: bytes, head: ChunkHead, piece: Piece, loaded: Loaded) -> bytes:
    data = inflate_some(memoryview(raw)[head.begin : head.end], head.compression, head.size)
    reason = f"this chunk is cut off; {len(data)} of its {head.size} bytes could be read"
    loaded.holes.append(Hole(piece.offset, reason))
    return data


def _whole_chunk(piece: Piece, raw: bytes, want: Want, reason: str) -> Iterator[Hole]:
    """Yield the loss of a chunk, by channel where its index says how many messages each had."""
    if not piece.indexes:
        yield Hole(piece.offset, reason)
    for key, offset in piece.index_offsets():
        if key in want.keys:
            try:
                count: int | None = len(_entries(raw, piece, key, offset)) // _ENTRY.itemsize
            except BagError:
                count = None
            yield Hole(piece.offset, reason, key=key, count=count)


def _entries(raw: bytes, piece: Piece, key: int, offset: int) -> bytes:
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


def _by_index(data: bytes | memoryview, raw: bytes, piece: Piece, want: Want, loaded: Loaded) -> bool:
    """Add the wanted messages that the chunk's message indexes name; return whether they could be trusted."""
    wanted = [(key, offset) for key, offset in piece.index_offsets() if key in want.keys]
    if not wanted:
        return True
    try:
        indexes = [_entries(raw, piece, key, offset) for key, offset in wanted]
        counts = [len(index) // _ENTRY.itemsize for index in indexes]
        keys = np.repeat(np.array([key for key, _ in wanted], np.uint16), counts)
        entries = np.frombuffer(b"".join(indexes), _ENTRY)
        whole = _indexed(np.frombuffer(data, np.uint8), entries, keys, piece)
    except BagError as err:
        loaded.holes.append(Hole(piece.offset, f"{err.what}; the chunk was read record by record", count=0))
        return False
    edges = np.cumsum([0, *counts]).tolist()
    spans = [slice(begin, end) for begin, end in pairwise(edges)]
    keep_each(whole, [(key, span) for (key, _), span in zip(wanted, spans, strict=True)], want, loaded)
    return True


def _indexed(records: Bytes, entries: NDArray[np.void], keys: NDArray[np.uint16], piece: Piece) -> Slab:
    """Return the messages of all these index entries, checked at once against the records.

    Raises:
        BagError: An entry does not agree with its record.
    """
    if len(entries) and int(entries["offset"].max()) > len(records) - _HEAD.itemsize:
        raise BagError("a message index points outside its chunk")
    starts = entries["offset"].astype(np.int64)
    heads = _heads(records, starts)
    fits = (heads["op"] == Op.MESSAGE) & (heads["channel"] == keys) & (heads["time"] == entries["time"])
    if not bool((fits & _within(heads, starts, len(records))).all()):
        raise BagError("a message index does not point at its messages")
    return _slab(records, heads, starts, piece)


def _message_starts(data: bytes | memoryview, piece: Piece, loaded: Loaded) -> NDArray[np.int64]:
    """Return where messages begin, up to the first record that does not fit."""
    found: list[int] = []
    at = 0
    while at < len(data):
        op, length = RECORD.unpack_from(data, at) if at + RECORD.size <= len(data) else (0, 0)
        end = at + RECORD.size + length
        if op == 0 or end > len(data):
            reason = f"no whole record at byte {at} of {len(data)}; the rest is not read"
            loaded.holes.append(Hole(piece.offset, reason))
            break
        if op == Op.MESSAGE and length >= _FIXED_BYTES:
            found.append(at)
        elif op == Op.MESSAGE:
            reason = f"a message record of {length} bytes at byte {at}, too few for its fields"
            loaded.holes.append(Hole(piece.offset, reason))
        at = end
    return np.array(found, np.int64)


def _heads(records: Bytes, starts: NDArray[np.int64]) -> NDArray[np.void]:
    if not len(starts):
        return np.empty(0, _HEAD)
    return stretches(records, starts, _HEAD.itemsize).view(_HEAD).reshape(-1)


def _within(heads: NDArray[np.void], starts: NDArray[np.int64], size: int) -> NDArray[np.bool_]:
    length = heads["length"]
    room = (size - RECORD.size - starts).astype(np.uint64)
    return (length >= _FIXED_BYTES) & (length <= room)


def _slab(records: Bytes, heads: NDArray[np.void], starts: NDArray[np.int64], piece: Piece) -> Slab:
    """Return messages, of any channel, whose records have been checked; chunks tell where they lie, or they do."""
    offsets = np.full(len(starts), piece.offset, np.int64) if piece.is_chunk else starts + piece.offset
    lengths = heads["length"].astype(np.int64) - _FIXED_BYTES
    return Slab(-1, np.ascontiguousarray(heads["time"]), records, starts + _HEAD.itemsize, lengths, offsets)
