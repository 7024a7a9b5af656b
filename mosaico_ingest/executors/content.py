"""This file names the content of files: by samples, quickly, or by every byte of them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from xxhash import xxh3_128

from mosaico_ingest.errors import BagError

__all__ = ["content_digest", "whole_digest"]

_READ_BYTES = 1 << 20
_SAMPLES = 64
_PIECE_BYTES = 64 << 20


def content_digest(path: Path) -> str:
    """Return a name for the content of a file: XXH3 (128 bits) over its length and all of it, or 64 MiB of it.

    Of a longer file these are pieces of a MiB, evenly from its first byte to its last, so that many long recordings are
    looked at without reading them. A new recording differs in each of them; it is no defence against forgery.

    Raises:
        BagError: The file cannot be read.
    """
    size = _size(path)
    if size <= _SAMPLES * _READ_BYTES:
        return _digest(path, size, [(0, size)])
    step = (size - _READ_BYTES) / (_SAMPLES - 1)
    return _digest(path, size, [(int(number * step), _READ_BYTES) for number in range(_SAMPLES)])


def whole_digest(path: Path) -> str | None:
    """Return a name for every byte of a file, None where `content_digest` is one; pieces are read side by side.

    Raises:
        BagError: The file cannot be read.
    """
    size = _size(path)
    if size <= _SAMPLES * _READ_BYTES:
        return None
    pieces = [(start, min(_PIECE_BYTES, size - start)) for start in range(0, size, _PIECE_BYTES)]
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1), thread_name_prefix="digest") as pool:
        digests = pool.map(partial(_digest, path, size), ([piece] for piece in pieces))
        return xxh3_128("".join(digests).encode()).hexdigest()


def _digest(path: Path, size: int, pieces: Iterable[tuple[int, int]]) -> str:
    """Digest the length of a file and the stretches of it that begin and are as long as `pieces` says."""
    digest = xxh3_128(size.to_bytes(8, "little"))
    room = memoryview(bytearray(_READ_BYTES))
    try:
        with path.open("rb", buffering=0) as file:
            for start, left in pieces:
                file.seek(start)
                while left and (got := file.readinto(room[: min(left, _READ_BYTES)])):
                    digest.update(room[:got])
                    left -= got  # noqa: PLW2901 - what is left of this piece
    except OSError as error:
        raise _unreadable(path, error) from error
    return digest.hexdigest()


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: OSError) -> BagError:
    return BagError(f"cannot be read: {error.strerror}", where=str(path))
