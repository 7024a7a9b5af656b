"""Decompression of chunks, files and messages with bounded memory."""

from __future__ import annotations

import bz2
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, Protocol

import lz4.frame
import numpy as np
import pyarrow as pa
import zstandard
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.blocks import Slab, UnreadableRange, stretches
from mosaico_ingest.rosbag.formats import ZSTD

__all__ = [
    "Inflated",
    "Packed",
    "inflate",
    "inflate_all",
    "inflate_file",
    "inflate_message",
    "inflate_messages",
    "inflate_some",
    "room",
]


def room(size: int) -> NDArray[np.uint8]:
    """Return `size` bytes of no known value from Arrow's pool, which gives out again what was freed.

    Those of `numpy.empty` are new pages every time, and to touch them takes longer than to copy a picture into them.
    """
    return np.frombuffer(memoryview(pa.allocate_buffer(size)), np.uint8)


_STEP_BYTES = 1 << 12
"""What is inflated at once: zstd makes at most 128 MiB of it, so that a bomb is noticed on the way."""
_LZ4_RATIO = 255
"""What lz4 can reach at best."""
_ZSTD_RATIO = 64
"""Up to this ratio the announced size is allocated at once; beyond, memory grows with the bytes that come out."""
_TOGETHER_BYTES = 64 << 20
"""Up to here the announced sizes of several chunks are allocated at once."""
_FAILURES = (zstandard.ZstdError, RuntimeError, OSError, EOFError, ValueError, MemoryError)


Bytes = NDArray[np.uint8]


class _Stream(Protocol):
    @property
    def eof(self) -> bool: ...
    def decompress(self, data: bytes, /) -> bytes: ...


_STREAMS: dict[str, Callable[[], Any]] = {  # of _Stream; lz4 has no annotations to say so
    "zstd": lambda: zstandard.ZstdDecompressor().decompressobj(),
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "bz2": bz2.BZ2Decompressor,
}


def inflate(data: bytes | memoryview, compression: str, size: int) -> bytes | memoryview:
    """Return the `size` bytes that `data` holds.

    Raises:
        BagError: The compression is unknown, the data are damaged, or they hold another number of bytes.
    """
    if _is_plain(compression):
        whole: bytes | memoryview = data
    else:
        try:
            whole = _inflate(data, compression, size)
        except _FAILURES as err:
            raise BagError(f"damaged {compression} data: {err}") from err
    if len(whole) != size:
        raise BagError(f"{size} bytes announced, {len(whole)} found")
    return whole


class Packed(Struct, frozen=True):
    """Where a chunk's data lie in what was read, and what the chunk says of them."""

    begin: int
    end: int
    compression: str
    size: int


class Inflated(Struct, frozen=True):
    """One buffer with what is in some chunks, where in it each begins and ends, and which are damaged."""

    data: Bytes
    places: list[tuple[int, int]]
    failures: dict[int, BagError]


def inflate_all(data: Bytes, chunks: Sequence[Packed]) -> Inflated:
    """Return what is in the chunks, whose data lie in `data`; chunks that are not compressed stay there."""
    if all(_is_plain(chunk.compression) and chunk.end - chunk.begin == chunk.size for chunk in chunks):
        return Inflated(data, [(chunk.begin, chunk.end) for chunk in chunks], {})
    failures: dict[int, BagError] = {}
    total = sum(chunk.size for chunk in chunks)
    if len(chunks) != 1 and total <= _TOGETHER_BYTES:
        buffer = room(total)
        places = _side_by_side(chunk.size for chunk in chunks)
        for number, (chunk, (begin, end)) in enumerate(zip(chunks, places, strict=True)):
            try:
                _inflate_into(buffer[begin:end], chunk, data)
            except BagError as err:  # noqa: PERF203 - each chunk may fail for itself
                failures[number] = err
        return Inflated(buffer, places, failures)
    pieces: list[Bytes] = []
    for number, chunk in enumerate(chunks):
        try:
            pieces.append(_inflated(chunk, data))
        except BagError as err:  # noqa: PERF203 - as above
            failures[number] = err
            pieces.append(np.empty(0, np.uint8))
    whole = pieces[0] if len(pieces) == 1 else np.concatenate(pieces)
    return Inflated(whole, _side_by_side(map(len, pieces)), failures)


def _side_by_side(sizes: Iterable[int]) -> list[tuple[int, int]]:
    return list(pairwise(accumulate(sizes, initial=0)))


def _is_plain(compression: str) -> bool:
    return compression in {"", "none"}


def _inflated(chunk: Packed, data: Bytes) -> Bytes:
    packed = data[chunk.begin : chunk.end].data
    return np.frombuffer(inflate(packed, chunk.compression, chunk.size), np.uint8)


def _inflate_into(target: Bytes, chunk: Packed, data: Bytes) -> None:
    """Fill `target` with what is in a chunk, without a copy where the library can do that."""
    if chunk.compression != "zstd" or not len(target):
        target[:] = _inflated(chunk, data)
        return
    try:
        stream = zstandard.ZstdDecompressor().stream_reader(data[chunk.begin : chunk.end].data)
        found = stream.readinto(target.data)
        more = stream.read(1)
    except _FAILURES as err:
        raise BagError(f"damaged zstd data: {err}") from err
    if found != len(target) or more:
        raise BagError(f"{len(target)} bytes announced, {'more' if more else found} found")


def inflate_some(data: bytes | memoryview, compression: str, size: int) -> bytes:
    """Return what can be had of a chunk that is cut off or damaged, at most `size` bytes; maybe nothing."""
    if _is_plain(compression):
        return bytes(data[:size])
    found = bytearray()
    try:
        for piece in _pieces(data, compression):
            found += piece
            if len(found) >= size:
                break
    except _FAILURES:
        pass  # what came before the damage is what there is
    return bytes(found[:size])


def inflate_message(data: bytes, limit: int) -> bytes:
    """Return the message inside one zstd frame.

    Raises:
        BagError: The frame is damaged, cut off, or holds more than `limit` bytes.
    """
    found = bytearray()
    stream = zstandard.ZstdDecompressor().decompressobj()
    try:
        for position in range(0, len(data), _STEP_BYTES):
            found += stream.decompress(data[position : position + _STEP_BYTES])
            if len(found) > limit:
                raise BagError(f"the compressed message holds more than {limit} bytes")
            if stream.eof:
                return bytes(found)
    except zstandard.ZstdError as err:
        raise BagError(f"damaged zstd message: {err}") from err
    raise BagError(f"the zstd message is cut off after {len(data)} bytes")


def inflate_file(source: Path, target: Path) -> str | None:
    """Write what the zstd file `source` holds to `target`; return why it ended early, if it did."""
    stream = None
    try:
        with source.open("rb") as packed, target.open("wb") as plain:
            for data in iter(lambda: packed.read(_STEP_BYTES), b""):
                rest = data
                while rest:
                    stream = stream or zstandard.ZstdDecompressor().decompressobj()
                    plain.write(stream.decompress(rest))
                    rest = stream.unused_data if stream.eof else b""
                    stream = None if stream.eof else stream
    except zstandard.ZstdError as err:
        return f"damaged zstd file: {err}"
    return "the zstd file is cut off" if stream else None


def _inflate(data: bytes | memoryview, compression: str, size: int) -> bytes:
    if compression == "lz4" and size <= _LZ4_RATIO * len(data):
        announced = lz4.frame.get_frame_info(data)["content_size"]
        if announced not in (0, size):
            raise BagError(f"{size} bytes announced, the lz4 frame announces {announced}")
        return lz4.frame.decompress(data)
    if compression == "zstd" and 0 < size <= _ZSTD_RATIO * len(data):
        announced = zstandard.get_frame_parameters(data).content_size
        if announced not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise BagError(f"{size} bytes announced, the zstd frame announces {announced}")
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    return _joined(_pieces(data, compression), size)


def _joined(pieces: Iterable[bytes], size: int) -> bytes:
    found = bytearray()
    for piece in pieces:
        found += piece
        if len(found) > size:
            raise BagError(f"{size} bytes announced, more found")
    return bytes(found)


def _pieces(data: bytes | memoryview, compression: str) -> Iterator[bytes]:
    """Inflate in steps of the input, so that a lying size or a bomb is noticed on the way."""
    if compression not in _STREAMS:
        raise BagError(f"compression {compression!r} is unknown; known are none, zstd, lz4, bz2")
    stream: _Stream = _STREAMS[compression]()
    for position in range(0, len(data), _STEP_BYTES):
        yield stream.decompress(bytes(data[position : position + _STEP_BYTES]))
        if stream.eof:
            return


_LIMIT_BYTES = 256 << 20
_MAGIC = np.frombuffer(ZSTD, "<u4")[0]


def inflate_messages(slab: Slab, unreadable: list[UnreadableRange]) -> Slab:
    """Return CDR messages as they were before compression; no CDR message begins as a zstd frame does.

    Whether any is, the first and the last tell; others that are not stay as they are, damaged ones are noted as lost.
    """
    if not (_is_packed(slab, 0) or _is_packed(slab, -1)):
        return slab
    long_enough = slab.lengths >= len(ZSTD)
    heads = stretches(slab.data, slab.starts[long_enough], len(ZSTD)).view("<u4").reshape(-1)
    packed = np.flatnonzero(long_enough)[heads == _MAGIC]
    is_packed = np.zeros(len(slab), np.bool_)
    is_packed[packed] = True
    kept: list[int] = []
    payloads: list[bytes] = []
    for row in range(len(slab)):
        start = int(slab.starts[row])
        payload = slab.data[start : start + int(slab.lengths[row])].tobytes()
        try:
            payloads.append(inflate_message(payload, _LIMIT_BYTES) if is_packed[row] else payload)
        except BagError as err:
            unreadable.append(UnreadableRange(int(slab.offsets[row]), err.what, connection=slab.key, count=1))
        else:
            kept.append(row)
    rows = slab.rows(np.array(kept, np.int64))
    lengths = np.array([len(payload) for payload in payloads], np.int64)
    data = np.frombuffer(b"".join(payloads), np.uint8)
    return Slab(slab.key, rows.log_times, data, np.cumsum(lengths) - lengths, lengths, rows.offsets)


def _is_packed(slab: Slab, row: int) -> bool:
    start = int(slab.starts[row])
    return slab.data[start : start + min(int(slab.lengths[row]), len(ZSTD))].tobytes() == ZSTD
