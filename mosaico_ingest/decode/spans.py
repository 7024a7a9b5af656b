"""Offsets of values in a buffer, and copies of the values into Arrow arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.rosbag.blocks import Bytes, Int64s
from mosaico_ingest.rosbag.compression import allocate

_LARGE_BYTES = 4096
"""Average slice size above which individual copies are faster than `take`."""
_FAR_BYTES = 1 << 28
"""Maximum distance of the first and last slice for `take`, which reserves half as many bytes."""

Array: TypeAlias = "pa.Array[Any]"


class Payloads(Struct, frozen=True):
    """n payloads of one byte order in a buffer, without their encapsulation headers; shapes (n,)."""

    data: Bytes
    order: str
    """`<` or `>`, as in numpy and struct."""
    origins: Int64s
    """Start of each payload, from which CDR counts alignment."""
    ends: Int64s

    def __len__(self) -> int:
        """Return the number of payloads."""
        return len(self.origins)

    def take(self, rows: Int64s) -> Payloads:
        """Return the selected payloads."""
        return Payloads(self.data, self.order, self.origins[rows], self.ends[rows])

    def words(self) -> NDArray[np.uint32]:
        """Return a view with the 32-bit word at each byte of the buffer; it reads length words at any offset."""
        count = max(len(self.data) - 3, 0)
        return np.ndarray((count,), f"{self.order}u4", self.data.data, 0, (1,))


class StepOffsets(Struct, frozen=True):
    """The offsets of one layout step in m instances of its body, ordered by message."""

    at: Int64s
    """Offset of the first byte after any length word, shape (m,)."""
    count: Int64s | None = None
    """Units of a text, or elements of a run or loop, shape (m,); None for a block."""
    body: BodyOffsets = ()
    """Offsets of the steps of a loop's elements: sum(count) instances."""

    @property
    def counts(self) -> Int64s:
        """`count`, or zeros for a block."""
        return np.zeros_like(self.at) if self.count is None else self.count

    def take(self, index: Int64s) -> StepOffsets:
        """Return the offsets in the selected instances."""
        count = None if self.count is None else self.count[index]
        if self.count is None or count is None or not self.body:
            return StepOffsets(self.at[index], count)
        firsts = np.cumsum(self.count) - self.count
        elements = expand_ranges(firsts[index], count)
        return StepOffsets(self.at[index], count, tuple(step.take(elements) for step in self.body))

    def repeat_at(self, origins: Int64s) -> StepOffsets:
        """Return the offsets of a message at offset 0 for messages with the same layout at `origins`."""
        at = (origins[:, None] + self.at).ravel()
        count = None if self.count is None else np.tile(self.count, len(origins))
        return StepOffsets(at, count, tuple(step.repeat_at(origins) for step in self.body))


BodyOffsets: TypeAlias = tuple[StepOffsets, ...]
"""The offsets of each step of a body."""


class LocatedMessages(Struct, frozen=True):
    """The n payloads whose bytes match the layout, and the offsets of their values."""

    rows: Int64s
    """Index of each in its `Payloads`, ascending, shape (n,)."""
    tails: Int64s
    """Bytes after the last value, shape (n,)."""
    offsets: BodyOffsets

    def take(self, index: Int64s) -> LocatedMessages:
        """Return the selected messages; `index` ascends."""
        offsets = tuple(step.take(index) for step in self.offsets)
        return LocatedMessages(self.rows[index], self.tails[index], offsets)


def expand_ranges(firsts: Int64s, counts: Int64s, stride: int = 1) -> Int64s:
    """Return `firsts[i] + j * stride` for each i and each j in range(counts[i])."""
    ends = np.cumsum(counts)
    total = int(ends[-1]) if len(ends) else 0
    return np.repeat(firsts - (ends - counts) * stride, counts) + np.arange(total) * stride


def interleave(parts: Sequence[BodyOffsets], slots: Int64s) -> BodyOffsets:
    """Concatenate the instances of all parts and move instance i to position `slots[i]`, a permutation."""
    order = np.empty(len(slots), np.int64)
    order[slots] = np.arange(len(slots))
    return tuple(_concatenate(steps).take(order) for steps in zip(*parts, strict=True))


def _concatenate(parts: tuple[StepOffsets, ...]) -> StepOffsets:
    at = np.concatenate([part.at for part in parts])
    counts = [part.count for part in parts if part.count is not None]
    bodies = zip(*(part.body for part in parts), strict=True)
    return StepOffsets(at, np.concatenate(counts) if counts else None, tuple(map(_concatenate, bodies)))


class Cells(Struct, frozen=True):
    """`count` fixed-size structs in `data`: the first at `start`, the others `stride` bytes apart."""

    data: Bytes
    count: int
    stride: int
    start: int = 0

    def numbers(self, kind: np.dtype[Any], offset: int, dims: Sequence[tuple[int, int]] = ()) -> NDArray[Any]:
        """Return a view of the number at `offset` in each struct; `dims` are (count, stride) of surrounding arrays."""
        counts, strides = zip(*dims, strict=True) if dims else ((), ())
        at = self.start + offset if self.count else 0
        return np.ndarray((self.count, *counts), kind, self.data.data, at, (self.stride, *strides))


def fixed_cells(data: Bytes, at: Int64s, size: int) -> Cells:
    """Return the structs of `size` bytes at some offsets: a view if they are equidistant, else a copy."""
    if not len(at) or not size:
        return Cells(np.zeros(0, np.uint8), len(at), 0)
    stride = _stride(at)
    if stride is not None:
        return Cells(data, len(at), stride, int(at[0]))
    view = np.ndarray((len(data) - size + 1,), f"V{size}", data.data, 0, (1,))
    return Cells(view[at].view(np.uint8), len(at), size)


def bytes_at(data: Bytes, at: Int64s) -> Bytes:
    """Return the byte at each offset."""
    return fixed_cells(data, at, 1).numbers(np.dtype(np.uint8), 0)


def _stride(at: Int64s) -> int | None:
    """Return the distance of ascending, equidistant offsets; None for others."""
    stride = int(at[-1] - at[0]) // max(len(at) - 1, 1)
    if stride <= 0 or int(at[0]) + stride * (len(at) - 1) != at[-1]:
        return stride if len(at) == 1 else None
    return stride if (at[1:] - at[:-1] == stride).all() else None


def copy_slices(data: Bytes, at: Int64s, sizes: Int64s) -> Bytes:
    """Return the slices `data[at[i] : at[i] + sizes[i]]` one after the other; a view if they are adjacent in `data`."""
    if not len(at):
        return np.zeros(0, np.uint8)
    ends = at + sizes
    if (at[1:] == ends[:-1]).all():
        return data[at[0] : ends[-1]]
    if sizes[0] == sizes.max() == sizes.min():
        size = int(sizes[0])
        cells = fixed_cells(data, at, size).numbers(np.dtype(f"V{size}"), 0)
        return np.ascontiguousarray(cells).view(np.uint8)
    total = int(sizes.sum())
    if total > _LARGE_BYTES * len(at):
        return _copy_one_by_one(data, at, ends, total)
    if int(ends.max() - at.min()) > _FAR_BYTES:
        return data[expand_ranges(at, sizes)]
    return _copy_with_take(data, at, ends)[:total]


def _copy_one_by_one(data: Bytes, at: Int64s, ends: Int64s, total: int) -> Bytes:
    copy = allocate(total)
    position = 0
    for start, end in zip(at.tolist(), ends.tolist(), strict=True):
        copy[position : position + end - start] = data[start:end]
        position += end - start
    return copy


def _copy_with_take(data: Bytes, at: Int64s, ends: Int64s) -> Bytes:
    """Copy the slices with Arrow's `take`, from a binary array over the buffer in which they are every other value."""
    picks = np.arange(0, 2 * len(at), 2)
    if (at[1:] < ends[:-1]).any():  # the offsets of a binary array must ascend
        order = np.argsort(at, kind="stable")
        picks = np.empty_like(picks)
        picks[order] = np.arange(0, 2 * len(at), 2)
        at, ends = at[order], ends[order]
    borders = np.stack([at, ends], axis=1).reshape(-1)
    slices = array_of(pa.large_binary(), len(borders) - 1, borders, data)
    copy = slices.take(array_of(pa.int64(), len(picks), picks)).buffers()[-1]
    return np.zeros(0, np.uint8) if copy is None else np.frombuffer(memoryview(copy), np.uint8)


def list_offsets(counts: Int64s) -> NDArray[np.int32]:
    """Return the Arrow offsets of values with `counts` bytes or elements, shape (len(counts) + 1,)."""
    offsets = np.zeros(len(counts) + 1, np.int32)
    np.cumsum(counts, out=offsets[1:])
    return offsets


def array_of(
    kind: pa.DataType, length: int, *buffers: NDArray[Any], children: Sequence[Array] | None = None
) -> Array:
    """Return an Arrow array without nulls over the buffers that follow the validity bitmap.

    Unlike `pyarrow.array`, this does not import pandas, which takes longer than decoding most blocks.
    """
    parts = [None, *(pa.py_buffer(buffer.data) for buffer in buffers)]
    return pa.Array.from_buffers(kind, length, parts, children=children)
