"""This file copies bytes from where they lie into one piece, once."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from mosaico_ingest.decode.places import Int64s

__all__ = ["cells", "spans"]

_LARGE = 4096
"""Bytes from which on a copy of its own is faster than taking the value among others."""


def cells(data: NDArray[np.uint8], at: Int64s, size: int) -> NDArray[np.uint8]:
    """Return the `size` bytes at each position, shape (len(at), size)."""
    if not len(at) or not size:
        return np.zeros((len(at), size), np.uint8)
    view = np.ndarray((len(data) - size + 1,), f"V{size}", data.data, 0, (1,))
    return view[at].view(np.uint8).reshape(len(at), size)


def spans(data: NDArray[np.uint8], at: Int64s, sizes: Int64s) -> NDArray[np.uint8]:
    """Return `sizes[i]` bytes from each `at[i]`, one behind the other; a view where they lie so already."""
    if not len(at):
        return np.zeros(0, np.uint8)
    ends = at + sizes
    if (at[1:] == ends[:-1]).all():
        return data[at[0] : ends[-1]]
    if sizes[0] == sizes.max() == sizes.min():
        return cells(data, at, int(sizes[0])).reshape(-1)
    total = int(sizes.sum())
    if total > _LARGE * len(at):
        return _copied(data, at, ends, total)
    return _taken(data, at, ends)[:total]


def _copied(data: NDArray[np.uint8], at: Int64s, ends: Int64s, total: int) -> NDArray[np.uint8]:
    out = np.empty(total, np.uint8)
    pos = 0
    for start, end in zip(at.tolist(), ends.tolist(), strict=True):
        out[pos : pos + end - start] = data[start:end]
        pos += end - start
    return out


def _taken(data: NDArray[np.uint8], at: Int64s, ends: Int64s) -> NDArray[np.uint8]:
    """Copy by Arrow's `take`: to it the spans are every other value of one binary array over the buffer."""
    picks = np.arange(0, 2 * len(at), 2)
    if (at[1:] < ends[:-1]).any():  # not ascending, as its offsets have to be
        order = np.argsort(at, kind="stable")
        picks = np.empty_like(picks)
        picks[order] = np.arange(0, 2 * len(at), 2)
        at, ends = at[order], ends[order]
    borders = np.stack([at, ends], axis=1)
    every = pa.Array.from_buffers(
        pa.large_binary(), borders.size - 1, [None, pa.py_buffer(borders), pa.py_buffer(data)]
    )
    return np.frombuffer(every.take(pa.array(picks)).buffers()[2], np.uint8)
