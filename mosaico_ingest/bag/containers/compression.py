"""This file inflates chunks, files and messages, and believes no announced size before the bytes are there."""

from __future__ import annotations

import bz2
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Protocol

import lz4.frame
import zstandard

from mosaico_ingest.errors import BagError

__all__ = ["ZSTD_MAGIC", "inflate", "inflate_file", "inflate_message", "inflate_some"]

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_STEP_BYTES = 1 << 12
"""What is inflated at once: zstd makes at most 128 MiB of it, so that a bomb is noticed on the way."""
_LZ4_RATIO = 255
"""What lz4 can reach at best."""
_ZSTD_RATIO = 64
"""Up to here the announced size is allocated at once; beyond, memory grows with what really comes out."""
_FAILURES = (zstandard.ZstdError, RuntimeError, OSError, EOFError, ValueError, MemoryError)


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
    if not compression or compression == "none":
        whole: bytes | memoryview = data
    else:
        try:
            whole = _inflate(data, compression, size)
        except _FAILURES as err:
            raise BagError(f"damaged {compression} data: {err}") from err
    if len(whole) != size:
        raise BagError(f"{size} bytes announced, {len(whole)} found")
    return whole


def inflate_some(data: bytes | memoryview, compression: str, size: int) -> bytes:
    """Return what can be had of a chunk that is cut off or damaged, at most `size` bytes; maybe nothing."""
    if not compression or compression == "none":
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
