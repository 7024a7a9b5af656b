"""Spans of bytes in a buffer, and copies of them into Arrow arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.rosbag.compression import allocate

__all__ = [
    "Array",
    "Cells",
    "Frame",
    "Int64s",
    "Located",
    "Place",
    "Places",
    "array_of",
    "bytes_at",
    "cells",
    "expand",
    "join",
    "offsets_of",
    "spans",
]

Int64s: TypeAlias = NDArray[np.int64]


class Frame(Struct, frozen=True):
    """n messages of one byte order in a buffer; alignment counts from `origins`, shapes (n,)."""

    data: NDArray[np.uint8]
    order: str
    """`<` or `>`, as numpy and struct spell it."""
    origins: Int64s
    ends: Int64s

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.origins)

    def take(self, rows: Int64s) -> Frame:
        """Return some of the messages."""
        return Frame(self.data, self.order, self.origins[rows], self.ends[rows])

    def words(self) -> NDArray[np.uint32]:
        """Return the length word that begins at each byte of the buffer, without copying it."""
        count = max(len(self.data) - 3, 0)
        return np.ndarray((count,), f"{self.order}u4", self.data.data, 0, (1,))


class Place(Struct, frozen=True):
    """Where one step lies in each of m instances of its body, in the order of the messages."""

    at: Int64s
    """The first byte, shape (m,)."""
    count: Int64s | None = None
    """Bytes of a text, elements of a run or loop, shape (m,); None for a block."""
    body: Places = ()
    """The steps of a loop's elements, one instance each, sum(count) in all."""

    @property
    def counts(self) -> Int64s:
        """The counts of a text, run or loop."""
        return np.zeros_like(self.at) if self.count is None else self.count

    def take(self, index: Int64s) -> Place:
        """Return the place in the instances of `index`, in that order."""
        count = None if self.count is None else self.count[index]
        if self.count is None or count is None or not self.body:
            return Place(self.at[index], count)
        firsts = np.cumsum(self.count) - self.count
        inner = expand(firsts[index], count)
        return Place(self.at[index], count, tuple(place.take(inner) for place in self.body))

    def spread(self, origins: Int64s) -> Place:
        """Return the place of a message whose origin is 0 in messages that are laid out like it."""
        at = (origins[:, None] + self.at).ravel()
        count = None if self.count is None else np.tile(self.count, len(origins))
        return Place(at, count, tuple(place.spread(origins) for place in self.body))


Places: TypeAlias = tuple[Place, ...]
"""One for each step of a body."""


class Located(Struct, frozen=True):
    """The n messages that fit the layout, and where their steps lie."""

    rows: Int64s
    """Their positions in the frame, ascending, shape (n,)."""
    tails: Int64s
    """How many bytes follow what the layout describes, shape (n,)."""
    places: Places

    def take(self, index: Int64s) -> Located:
        """Return some of the messages; `index` ascends."""
        return Located(self.rows[index], self.tails[index], tuple(place.take(index) for place in self.places))


def expand(firsts: Int64s, counts: Int64s, stride: int = 1) -> Int64s:
    """Return `firsts[i] + j * stride` for each i and each j below `counts[i]`."""
    ends = np.cumsum(counts)
    total = int(ends[-1]) if len(ends) else 0
    return np.repeat(firsts - (ends - counts) * stride, counts) + np.arange(total) * stride


def join(parts: Sequence[Places], slots: Int64s) -> Places:
    """Put the instances of all parts, one part behind the other, into the order of their `slots`, which are 0 to m-1."""
    order = np.empty(len(slots), np.int64)
    order[slots] = np.arange(len(slots))
    return tuple(_concatenate(pieces).take(order) for pieces in zip(*parts, strict=True))


def _concatenate(pieces: tuple[Place, ...]) -> Place:
    at = np.concatenate([piece.at for piece in pieces])
    counts = [piece.count for piece in pieces if piece.count is not None]
    bodies = zip(*(piece.body for piece in pieces), strict=True)
    return Place(at, np.concatenate(counts) if counts else None, tuple(map(_concatenate, bodies)))


Array: TypeAlias = "pa.Array[Any]"
Bytes: TypeAlias = NDArray[np.uint8]

_LARGE = 4096
"""Bytes from which on a copy of its own is faster than taking the value among others."""
_FAR = 1 << 28
"""Bytes from the first to the last value from which on taking, which reserves half as many, could be refused."""


class Cells(Struct, frozen=True):
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
    out = allocate(total)
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
