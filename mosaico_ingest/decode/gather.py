"""This file copies bytes from where they lie into one piece, once, and makes Arrow arrays of such pieces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from mosaico_ingest.bag.room import room
from mosaico_ingest.decode.places import Int64s, expand
from mosaico_ingest.frozen import frozen

__all__ = ["Array", "Cells", "array_of", "bytes_at", "cells", "offsets_of", "spans"]

Array: TypeAlias = "pa.Array[Any]"
Bytes: TypeAlias = NDArray[np.uint8]

_LARGE = 4096
"""Bytes from which on a copy of its own is faster than taking the value among others."""
_FAR = 1 << 28
"""Bytes from the first to the last value from which on taking, which reserves half as many, could be refused."""


@frozen
class Cells:
    """`count` pieces of one size: the first begins at `begin` in `data`, each other `stride` bytes further."""

    data: Bytes
    count: int
    stride: int
    begin: int = 0

    def numbers(self, kind: np.dtype[Any], offset: int, dims: Sequence[tuple[int, int]] = ()) -> NDArray[Any]:
        """Return what lies at `offset` in each piece; `dims` are (count, stride) of what is there more than once."""
        counts, strides = zip(*dims, strict=True) if dims else ((), ())
        at = self.begin + offset if self.count else 0
        return np.ndarray((self.count, *counts), kind, self.data.data, at, (self.stride, *strides))


def cells(data: Bytes, at: Int64s, size: int) -> Cells:
    """Return the `size` bytes at each position: where they are equally far from each other, they are not copied."""
    if not len(at) or not size:
        return Cells(np.zeros(0, np.uint8), len(at), 0)
    stride = _stride(at)
    if stride is not None:
        return Cells(data, len(at), stride, int(at[0]))
    view = np.ndarray((len(data) - size + 1,), f"V{size}", data.data, 0, (1,))
    return Cells(view[at].view(np.uint8), len(at), size)


def bytes_at(data: Bytes, at: Int64s) -> Bytes:
    """Return the byte at each position."""
    return cells(data, at, 1).numbers(np.dtype(np.uint8), 0)


def _stride(at: Int64s) -> int | None:
    """Return how far positions are from each other, where all are equally far and ascend."""
    stride = int(at[-1] - at[0]) // max(len(at) - 1, 1)
    if stride <= 0 or int(at[0]) + stride * (len(at) - 1) != at[-1]:
        return stride if len(at) == 1 else None
    return stride if (at[1:] - at[:-1] == stride).all() else None


def spans(data: Bytes, at: Int64s, sizes: Int64s) -> Bytes:
    """Return `sizes[i]` bytes from each `at[i]`, one behind the other; a view where they lie so already."""
    if not len(at):
        return np.zeros(0, np.uint8)
    ends = at + sizes
    if (at[1:] == ends[:-1]).all():
        return data[at[0] : ends[-1]]
    if sizes[0] == sizes.max() == sizes.min():
        size = int(sizes[0])
        return np.ascontiguousarray(cells(data, at, size).numbers(np.dtype(f"V{size}"), 0)).view(np.uint8)
    total = int(sizes.sum())
    if total > _LARGE * len(at):
        return _copied(data, at, ends, total)
    if int(ends.max() - at.min()) > _FAR:
        return data[expand(at, sizes)]
    return _taken(data, at, ends)[:total]


def _copied(data: Bytes, at: Int64s, ends: Int64s, total: int) -> Bytes:
    out = room(total)
    pos = 0
    for start, end in zip(at.tolist(), ends.tolist(), strict=True):
        out[pos : pos + end - start] = data[start:end]
        pos += end - start
    return out


def _taken(data: Bytes, at: Int64s, ends: Int64s) -> Bytes:
    """Copy by Arrow's `take`: to it the spans are every other value of one binary array over the buffer."""
    picks = np.arange(0, 2 * len(at), 2)
    if (at[1:] < ends[:-1]).any():  # not ascending, as its offsets have to be
        order = np.argsort(at, kind="stable")
        picks = np.empty_like(picks)
        picks[order] = np.arange(0, 2 * len(at), 2)
        at, ends = at[order], ends[order]
    borders = np.stack([at, ends], axis=1).reshape(-1)
    every = array_of(pa.large_binary(), len(borders) - 1, borders, data)
    taken = every.take(array_of(pa.int64(), len(picks), picks)).buffers()[-1]
    return np.zeros(0, np.uint8) if taken is None else np.frombuffer(memoryview(taken), np.uint8)


def offsets_of(counts: Int64s) -> NDArray[np.int32]:
    """Return where each of the values begins that have `counts` bytes or elements, and where the last ends."""
    offsets = np.zeros(len(counts) + 1, np.int32)
    np.cumsum(counts, out=offsets[1:])
    return offsets


def array_of(
    kind: pa.DataType, length: int, *buffers: NDArray[Any], children: Sequence[Array] | None = None
) -> Array:
    """Return an Arrow array over the buffers that follow its validity, which no decoded value needs.

    Unlike `pyarrow.array` it does not look for pandas, whose import takes longer than most batches.
    """
    parts = [None, *(pa.py_buffer(buffer.data) for buffer in buffers)]
    return pa.Array.from_buffers(kind, length, parts, children=children)
