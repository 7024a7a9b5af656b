"""Layouts: a definition compiled to the steps that walk its messages, and the offsets of the values in a buffer.

The *steps* follow the bytes of a message. Consecutive values of fixed size form one `FixedBlock`, even across nested
structs, because their distances are constant. Only texts and sequences, whose sizes vary, are steps of their own.

The *columns* follow the Arrow type. Each leaf refers to a step, and for numbers to an offset in the step's block.

For example, `std_msgs/Header header; float64 x; float64[] ranges` in CDR has the steps `FixedBlock` (stamp), `Text`
(frame_id), `FixedBlock` (x), `Run` (ranges).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
from msgspec import Struct, field
from msgspec.structs import replace
from numpy.typing import NDArray

from mosaico_ingest.rosbag.blocks import Bytes, Encoding, Int64s
from mosaico_ingest.rosbag.compression import allocate
from mosaico_ingest.rosbag.definitions.linking import NUMBERS, TEXTS
from mosaico_ingest.rosbag.definitions.model import Container, Definition, Field, MessageType

_LARGE_BYTES = 4096
"""Average slice size above which individual copies are faster than `take`."""
_FAR_BYTES = 1 << 28
"""Maximum distance of the first and last slice for `take`, which reserves half as many bytes."""
WORD = 4
"""Bytes of a length word."""
PADDING, ZEROS = 3, 7
"""Maximum number of arbitrary bytes, and of zero bytes, after the last value of a CDR message."""
_MAX_ALIGN = 8
_UNITS = {"string": 1, "wstring": 4}
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


class FixedBlock(Struct, frozen=True):
    """Values of fixed size: `size` bytes that start at a multiple of `align`."""

    align: int
    size: int


class Text(Struct, frozen=True):
    """A string: a length word and that many units."""

    unit: int
    """Bytes per unit: 1 for `string`, 4 for `wstring`."""
    has_nul: bool = False
    """Whether the count includes a terminating NUL, as in a CDR `string`."""


class Run(Struct, frozen=True):
    """A sequence of elements of fixed size: a length word and that many cells, `stride` bytes apart."""

    cell: FixedBlock
    stride: int
    bound: int = 0
    """Maximum number of elements; 0 means unbounded."""


class Loop(Struct, frozen=True):
    """A sequence or array of elements of variable size, which must be walked one after the other."""

    body: Body
    count: int | None
    """Number of elements of an array; None for a sequence, which has a length word and may have a `bound`."""
    bound: int = 0


Step: TypeAlias = FixedBlock | Text | Run | Loop


class Body(Struct, frozen=True):
    """The steps of a message or of an element."""

    steps: tuple[Step, ...]
    least: int
    """Minimum size of an instance in bytes, without alignment."""


class NumberColumn(Struct, frozen=True):
    """A number at an offset in a block; `dims` are (count, stride) of the fixed arrays around it."""

    step: int
    offset: int
    type: str
    dims: tuple[tuple[int, int], ...] = ()


class TextColumn(Struct, frozen=True):
    """A string."""

    step: int
    text: Text


class FixedArrayColumn(Struct, frozen=True):
    """A fixed array within a block."""

    count: int
    item: Column


class ListColumn(Struct, frozen=True):
    """A list of the elements of a run or loop; the leaves of `item` refer to its cell or body."""

    step: int
    of: Run | Loop
    item: Column


class StructColumn(Struct, frozen=True):
    """A struct."""

    children: tuple[Column, ...]


Column: TypeAlias = NumberColumn | TextColumn | FixedArrayColumn | ListColumn | StructColumn


class Layout(Struct, frozen=True):
    """The steps and columns of one definition in one encoding."""

    encoding: Encoding
    body: Body
    record: StructColumn


def compile_layout(definition: Definition, encoding: Encoding) -> Layout:
    """Compile a definition whose `ros_shape` exists."""
    compiler = _Compiler(definition, aligned=encoding is Encoding.CDR)
    # The start of a message is aligned to the maximum, so no padding precedes its first block.
    draft = _Draft(open_block=FixedBlock(_MAX_ALIGN, 0))
    record = compiler.struct(definition.message, draft)
    return Layout(encoding, draft.body(), record)


class _Draft(Struct):
    """The steps compiled so far; `open_block` is a block that may still grow."""

    steps: list[Step] = field(default_factory=list[Step])
    open_block: FixedBlock | None = None

    def allocate(self, align: int, size: int) -> tuple[int, int]:
        """Add a value of `size` bytes; return the number of its step and its offset in the block."""
        block = self.open_block
        if block is None or align > block.align:
            self.close()
            block = FixedBlock(align, 0)
        offset = -(-block.size // align) * align
        self.open_block = replace(block, size=offset + size)
        return len(self.steps), offset

    def add(self, step: Step) -> int:
        self.close()
        self.steps.append(step)
        return len(self.steps) - 1

    def close(self) -> None:
        if self.open_block is not None and self.open_block.size:
            self.steps.append(self.open_block)
        self.open_block = None

    def body(self) -> Body:
        self.close()
        return Body(tuple(self.steps), sum(_least(step) for step in self.steps))


class _Compiler(Struct, frozen=True):
    definition: Definition
    aligned: bool

    def struct(self, message: MessageType, draft: _Draft) -> StructColumn:
        if self.aligned and not message.fields:
            draft.allocate(1, 1)  # CDR represents an empty struct by one unused byte
        return StructColumn(tuple(self._field(field, draft) for field in message.fields))

    def _field(self, field: Field, draft: _Draft) -> Column:
        if field.container is Container.SCALAR:
            return self._item(field, draft)
        inner = _Draft()
        item = self._item(field, inner)
        body = inner.body()
        cell = _single_block(body)
        if field.container is Container.SEQUENCE:
            many = Loop(body, None, field.size) if cell is None else Run(cell, _cell_stride(cell), field.size)
            return ListColumn(draft.add(many), many, item)
        if cell is None:
            loop = Loop(body, field.size)
            return ListColumn(draft.add(loop), loop, item)
        if not field.size:
            return FixedArrayColumn(0, item)
        stride = _cell_stride(cell)
        step, offset = draft.allocate(cell.align, stride * (field.size - 1) + cell.size)
        return FixedArrayColumn(field.size, _moved(item, step, offset, (field.size, stride)))

    def _item(self, field: Field, draft: _Draft) -> Column:
        if field.is_message:
            return self.struct(self.definition.types[field.type], draft)
        if field.type in TEXTS:
            text = Text(_UNITS[field.type], has_nul=self.aligned and field.type == "string")
            return TextColumn(draft.add(text), text)
        size = np.dtype(NUMBERS[field.type]).itemsize
        step, offset = draft.allocate(size if self.aligned else 1, size)
        return NumberColumn(step, offset, field.type)


def least_bytes(step: Step) -> int:
    """Return the minimum size of a unit or element that a step counts, at least 1."""
    match step:
        case Text(unit=unit):
            return unit
        case Run(cell=cell):
            return max(cell.size, 1)
        case Loop(body=body):
            return max(body.least, 1)
        case FixedBlock():
            return 1


def _single_block(body: Body) -> FixedBlock | None:
    """Return the block of a body that consists of one block, which means that its instances have a fixed size."""
    if not body.steps:
        return FixedBlock(1, 0)
    first = body.steps[0]
    return first if len(body.steps) == 1 and isinstance(first, FixedBlock) else None


def _cell_stride(cell: FixedBlock) -> int:
    return -(-cell.size // cell.align) * cell.align


def _least(step: Step) -> int:
    match step:
        case FixedBlock(size=size):
            return size
        case Loop(body=body, count=int(count)):
            return count * body.least
        case _:
            return WORD


def _moved(column: Column, step: int, offset: int, dim: tuple[int, int]) -> Column:
    """Return a column of an array's cell as a column of the block that contains the array."""
    match column:
        case NumberColumn():
            return NumberColumn(step, column.offset + offset, column.type, (dim, *column.dims))
        case FixedArrayColumn():
            return FixedArrayColumn(column.count, _moved(column.item, step, offset, dim))
        case StructColumn():
            return StructColumn(tuple(_moved(child, step, offset, dim) for child in column.children))
        case _:
            return column
