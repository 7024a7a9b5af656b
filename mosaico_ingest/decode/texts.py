"""This file makes text columns, and finds the values that are not Unicode."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from mosaico_ingest.decode.gather import Array, array_of, offsets_of
from mosaico_ingest.decode.places import Int64s

__all__ = ["owners_of", "utf8_texts", "wide_texts"]

_ASCII_END = 0x80
_UTF8_STEPS = (0x80, 0x800, 0x10000)
"""The code points from which on UTF-8 takes a byte more."""
_SURROGATES = (0xD800, 0xE000)
_UNICODE_END = 0x110000


def utf8_texts(kind: pa.DataType, sizes: Int64s, data: NDArray[np.uint8]) -> tuple[Array, Int64s]:
    """Return a text of each size, and which of them are not UTF-8."""
    texts = array_of(kind, len(sizes), offsets_of(sizes), data)
    if data.max(initial=0) < _ASCII_END:
        return texts, np.zeros(0, np.int64)
    try:
        texts.validate(full=True)
    except pa.ArrowInvalid:
        return texts, _not_utf8(sizes, data)
    return texts, np.zeros(0, np.int64)


def wide_texts(kind: pa.DataType, counts: Int64s, units: NDArray[np.unsignedinteger]) -> tuple[Array, Int64s]:
    """Return a text of each count of 32-bit units, and which of them are more than one code point a unit."""
    points = units.astype("<u4")
    wrong = ((points >= _SURROGATES[0]) & (points < _SURROGATES[1])) | (points >= _UNICODE_END)
    points[wrong] = 0
    sizes = 1 + sum((points >= step).astype(np.int64) for step in _UTF8_STEPS)
    ends = offsets_of(np.asarray(sizes))
    encoded = np.frombuffer(points.tobytes().decode("utf-32-le").encode(), np.uint8)
    texts = array_of(kind, len(counts), ends[offsets_of(counts)], encoded)
    return texts, np.unique(owners_of(counts, np.flatnonzero(wrong)))


def owners_of(counts: Int64s, which: Int64s) -> Int64s:
    """Return whose element each of `which` is, when owner i has the next `counts[i]` of them."""
    return np.searchsorted(np.cumsum(counts), which, side="right")


def _not_utf8(sizes: Int64s, data: NDArray[np.uint8]) -> Int64s:
    suspects = np.unique(owners_of(sizes, np.flatnonzero(data >= _ASCII_END)))
    ends = np.cumsum(sizes)
    wrong = [
        row for row in suspects.tolist() if not _is_utf8(data[ends[row] - sizes[row] : ends[row]].tobytes())
    ]
    return np.array(wrong, np.int64)


def _is_utf8(value: bytes) -> bool:
    try:
        value.decode()
    except UnicodeDecodeError:
        return False
    return True
