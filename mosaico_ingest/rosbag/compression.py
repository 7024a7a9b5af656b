"""Decompression of chunks, files and messages with bounded memory.

The size that a chunk declares is checked against a limit before anything is allocated. Decompression never produces
more than the declared size, and the decompressed bytes exist once.
"""

from __future__ import annotations

import bz2
from collections.abc import Callable, Iterator, Sequence
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, Protocol, TypeVar

import lz4.frame
import numpy as np
import pyarrow as pa
import zstandard
from msgspec import Struct

from mosaico_ingest.containers import ZSTD
from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.blocks import Bytes, MessageBlock, UnreadableRange, fixed_slices

CHUNK_LIMIT_KEY = "bag.max_chunk_size"
"""The manifest key of the limit, which messages name."""
MAX_CHUNK_BYTES = 256 << 20
"""Default limit for the decompressed size of a chunk."""
_MAX_MESSAGE_BYTES = 256 << 20
"""Limit for the decompressed size of a message that rosbag2 compressed individually."""
_MAX_BUFFER_BYTES = 64 << 20
"""Maximum size of a buffer that several chunks are decompressed into."""
_WINDOW_BYTES = 64 << 10
"""Bytes per step where decompression has to keep what precedes damage."""
_FILE_STEP_BYTES = 4 << 10
"""Compressed bytes per step of `decompress_file`; zstd expands them to at most 128 MiB."""
_ERRORS = (zstandard.ZstdError, RuntimeError, OSError, EOFError, ValueError, MemoryError)
"""Exceptions that the libraries raise for damaged data."""
T = TypeVar("T")
_ZSTD_MAGIC = np.frombuffer(ZSTD, "<u4")[0]


class CompressedChunk(Struct, frozen=True):
    """The position of a chunk's data in a buffer, its compression, and its decompressed size."""

    start: int
    end: int
    compression: str
    size: int
    """Decompressed size in bytes, as the chunk declares it."""


class DecompressedChunks(Struct, frozen=True):
    """The data of several chunks in one buffer, start and end of each, and the error of each damaged chunk."""

    data: Bytes
    bounds: list[tuple[int, int]]
    errors: dict[int, BagError]
    """By the chunk's position in the list."""


class _Decompressor(Protocol):
    @property
    def eof(self) -> bool: ...
    @property
    def needs_input(self) -> bool: ...
    def decompress(self, data: bytes | memoryview, max_length: int = -1) -> bytes: ...


_DECOMPRESSORS: dict[str, Callable[[], Any]] = {  # of _Decompressor; lz4 has no annotations
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "bz2": bz2.BZ2Decompressor,
}
_KNOWN = ("none", "zstd", *_DECOMPRESSORS)


def allocate(size: int) -> Bytes:
    """Return `size` uninitialized bytes from Arrow's memory pool.

    The pool reuses freed memory. `numpy.empty` maps new pages for large arrays, and faulting them in takes longer than
    copying an image into them.
    """
    return np.frombuffer(memoryview(pa.allocate_buffer(size)), np.uint8)


def is_plain(compression: str) -> bool:
    """Return whether the name stands for uncompressed data."""
    return compression in {"", "none"}


def check_chunk_size(compression: str, size: int, limit: int) -> None:
    """Raise BagError if a compressed chunk declares more than `limit` bytes."""
    if size > limit and not is_plain(compression):
        raise BagError(f"{size} bytes announced, more than the {limit} bytes of {CHUNK_LIMIT_KEY}")


def decompress(
    data: bytes | memoryview, compression: str, size: int, *, limit: int = MAX_CHUNK_BYTES
) -> Bytes:
    """Return the `size` decompressed bytes of a chunk.

    Raises:
        BagError: The compression is unknown, the size exceeds the limit, the data is damaged or of another size.
    """
    check_chunk_size(compression, size, limit)
    if is_plain(compression):
        plain = np.frombuffer(data, np.uint8)
        excess = False
    else:
        try:
            plain, excess = _decompress(data, compression, size)
        except _ERRORS as err:
            raise BagError(f"damaged {compression} data: {err}") from err
    if len(plain) != size or excess:
        raise BagError(f"{size} bytes announced, {'more' if excess else len(plain)} found")
    return plain


def decompress_chunks(
    data: Bytes, chunks: Sequence[CompressedChunk], *, limit: int = MAX_CHUNK_BYTES
) -> DecompressedChunks:
    """Decompress chunks whose data is in `data` into one buffer; plain chunks remain where they are."""
    if all(is_plain(chunk.compression) and chunk.end - chunk.start == chunk.size for chunk in chunks):
        return DecompressedChunks(data, [(chunk.start, chunk.end) for chunk in chunks], {})
    errors: dict[int, BagError] = {}
    if len(chunks) == 1:
        try:
            plain = _decompress_chunk(chunks[0], data, limit)
        except BagError as err:
            return DecompressedChunks(np.empty(0, np.uint8), [(0, 0)], {0: err})
        return DecompressedChunks(plain, [(0, len(plain))], {})
    sizes = [chunk.size if _is_allowed(chunk, limit) else 0 for chunk in chunks]
    bounds = list(pairwise(accumulate(sizes, initial=0)))
    buffer = allocate(sum(sizes))
    for number, (chunk, (start, end)) in enumerate(zip(chunks, bounds, strict=True)):
        try:
            _decompress_into(buffer[start:end], chunk, data, limit)
        except BagError as err:  # noqa: PERF203 - each chunk may be damaged
            errors[number] = err
    return DecompressedChunks(buffer, bounds, errors)


def decompression_groups(chunks: Sequence[T], size: Callable[[T], int]) -> list[Sequence[T]]:
    """Return the chunks as one group, or each one alone if they declare too many bytes for one buffer."""
    is_small = sum(map(size, chunks)) <= _MAX_BUFFER_BYTES
    return [chunks] if chunks and is_small else [[chunk] for chunk in chunks]


def decompress_partially(
    data: bytes | memoryview, compression: str, size: int, *, limit: int = MAX_CHUNK_BYTES
) -> Bytes:
    """Return the bytes of a truncated or damaged chunk that precede the damage, at most `size`; possibly none.

    Raises:
        BagError: The size exceeds the limit, or the compression is unknown.
    """
    check_chunk_size(compression, size, limit)
    if is_plain(compression):
        return np.frombuffer(data[:size], np.uint8)
    target = allocate(size)
    size_so_far = 0
    try:
        for window in _windows(data, compression):
            count = min(len(window), size - size_so_far)
            target[size_so_far : size_so_far + count] = np.frombuffer(window, np.uint8, count)
            size_so_far += count
            if size_so_far == size:
                break
    except _ERRORS:
        pass  # the bytes before the damage are the result
    return target[:size_so_far]


def decompress_message(data: bytes, limit: int) -> bytes:
    """Return the message in one zstd frame.

    Raises:
        BagError: The frame is damaged, truncated, or holds more than `limit` bytes.
    """
    message = bytearray()
    stream = zstandard.ZstdDecompressor().decompressobj()
    try:
        if zstandard.get_frame_parameters(data).content_size in range(limit + 1):
            return zstandard.ZstdDecompressor().decompress(data)
        for position in range(0, len(data), _FILE_STEP_BYTES):
            message += stream.decompress(data[position : position + _FILE_STEP_BYTES])
            if len(message) > limit:
                raise BagError(f"the compressed message holds more than {limit} bytes")
            if stream.eof:
                return bytes(message)
    except zstandard.ZstdError as err:
        raise BagError(f"damaged zstd message: {err}") from err
    raise BagError(f"the zstd message is truncated after {len(data)} bytes")


def decompress_messages(block: MessageBlock, unreadable: list[UnreadableRange]) -> MessageBlock:
    """Decompress the messages of a block that rosbag2 compressed individually.

    A CDR message never starts with the magic of zstd. If neither the first nor the last message is compressed, return
    the block unchanged. Damaged messages are dropped and added to `unreadable`.
    """
    if not (_is_compressed(block, 0) or _is_compressed(block, -1)):
        return block
    long_enough = block.lengths >= len(ZSTD)
    heads = fixed_slices(block.data, block.starts[long_enough], len(ZSTD)).view("<u4").reshape(-1)
    is_compressed = np.zeros(len(block), np.bool_)
    is_compressed[np.flatnonzero(long_enough)[heads == _ZSTD_MAGIC]] = True
    readable: list[int] = []
    payloads: list[bytes] = []
    for row in range(len(block)):
        payload = block.payload(row)
        try:
            payloads.append(
                decompress_message(payload, _MAX_MESSAGE_BYTES) if is_compressed[row] else payload
            )
        except BagError as err:
            offset = int(block.offsets[row])
            unreadable.append(UnreadableRange(offset, err.what, connection=block.connection, count=1))
        else:
            readable.append(row)
    rows = block.rows(np.array(readable, np.int64))
    lengths = np.array([len(payload) for payload in payloads], np.int64)
    data = np.frombuffer(b"".join(payloads), np.uint8)
    return MessageBlock(
        block.connection,
        rows.log_times,
        data,
        np.cumsum(lengths) - lengths,
        lengths,
        rows.offsets,
        rows.publish_times,
        rows.sequences,
    )


def decompress_file(source: Path, target: Path) -> str | None:
    """Decompress the zstd file `source` to `target`; return why it ended early, None if it is intact."""
    stream = None
    try:
        with source.open("rb") as compressed, target.open("wb") as plain:
            for data in iter(lambda: compressed.read(_FILE_STEP_BYTES), b""):
                rest = data
                while rest:
                    stream = stream or zstandard.ZstdDecompressor().decompressobj()
                    plain.write(stream.decompress(rest))
                    rest = stream.unused_data if stream.eof else b""
                    stream = None if stream.eof else stream
    except zstandard.ZstdError as err:
        return f"damaged zstd file: {err}"
    return "the zstd file is truncated" if stream else None


def _is_compressed(block: MessageBlock, row: int) -> bool:
    start = int(block.starts[row])
    return block.data[start : start + min(int(block.lengths[row]), len(ZSTD))].tobytes() == ZSTD


def _decompress(data: bytes | memoryview, compression: str, size: int) -> tuple[Bytes, bool]:
    """Return at most `size` bytes, and whether the data holds more."""
    if compression == "zstd":
        declared = zstandard.get_frame_parameters(data).content_size
        if declared == size and size:
            plain = zstandard.ZstdDecompressor().decompress(data)
            return np.frombuffer(plain, np.uint8), False
        if declared not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise BagError(f"{size} bytes announced, the zstd frame announces {declared}")
        target = allocate(size)
        length, excess = _zstd_into(target, data)
        return target[:length], excess
    decompressor = _decompressor(compression)
    plain = decompressor.decompress(data, max(size, 1))
    if len(plain) > size:
        return np.frombuffer(plain, np.uint8, size), True
    excess = b""
    if len(plain) == size and not decompressor.eof and not decompressor.needs_input:
        excess = decompressor.decompress(b"", 1)
    if not excess and not decompressor.eof:
        raise EOFError(f"the data is truncated after {len(plain)} decompressed bytes")
    return np.frombuffer(plain, np.uint8), bool(excess)


def _is_allowed(chunk: CompressedChunk, limit: int) -> bool:
    return chunk.size <= (chunk.end - chunk.start if is_plain(chunk.compression) else limit)


def _decompress_chunk(chunk: CompressedChunk, data: Bytes, limit: int) -> Bytes:
    return decompress(data[chunk.start : chunk.end].data, chunk.compression, chunk.size, limit=limit)


def _decompress_into(target: Bytes, chunk: CompressedChunk, data: Bytes, limit: int) -> None:
    """Fill `target` with the data of a chunk, for zstd without an intermediate copy."""
    if chunk.compression != "zstd" or not len(target):
        target[:] = _decompress_chunk(chunk, data, limit)
        return
    try:
        length, excess = _zstd_into(target, data[chunk.start : chunk.end].data)
    except _ERRORS as err:
        raise BagError(f"damaged zstd data: {err}") from err
    if length != len(target) or excess:
        raise BagError(f"{len(target)} bytes announced, {'more' if excess else length} found")


def _zstd_into(target: Bytes, data: bytes | memoryview) -> tuple[int, bool]:
    """Fill `target`; return the number of bytes written, and whether the data holds more."""
    stream = zstandard.ZstdDecompressor().stream_reader(data)
    return stream.readinto(target.data) if len(target) else 0, bool(stream.read(1))


def _windows(data: bytes | memoryview, compression: str) -> Iterator[bytes]:
    """Yield the decompressed data in windows, so that the windows before damage are not lost."""
    if compression == "zstd":
        stream = zstandard.ZstdDecompressor().stream_reader(data)
        yield from iter(lambda: stream.read(_WINDOW_BYTES), b"")
        return
    decompressor = _decompressor(compression)
    position = 0
    while not decompressor.eof:
        compressed = b""
        if decompressor.needs_input:
            compressed = bytes(data[position : position + _WINDOW_BYTES])
            position += len(compressed)
            if not compressed:
                return
        yield decompressor.decompress(compressed, _WINDOW_BYTES)


def _decompressor(compression: str) -> _Decompressor:
    if compression not in _DECOMPRESSORS:
        raise BagError(f"compression {compression!r} is unknown; the supported ones are {', '.join(_KNOWN)}")
    return _DECOMPRESSORS[compression]()
