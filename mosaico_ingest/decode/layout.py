"""Layouts: a definition compiled to the steps that walk its messages, and to the columns that the values become.

The *steps* follow the bytes of a message. Consecutive values of fixed size form one `FixedBlock`, even across nested
structs, because their distances are constant. Only texts and sequences, whose sizes vary, are steps of their own.

The *columns* follow the Arrow type. Each leaf refers to a step, and for numbers to an offset in the step's block.

For example, `std_msgs/Header header; float64 x; float64[] ranges` in CDR has the steps `FixedBlock` (stamp), `Text`
(frame_id), `FixedBlock` (x), `Run` (ranges).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.rosbag.blocks import Encoding
from mosaico_ingest.rosbag.definitions.linking import NUMBERS, TEXTS
from mosaico_ingest.rosbag.definitions.model import Container, Definition, Field, MessageType

WORD = 4
"""Bytes of a length word."""
PADDING, ZEROS = 3, 7
"""Maximum number of arbitrary bytes, and of zero bytes, after the last value of a CDR message."""
_MAX_ALIGN = 8
_UNITS = {"string": 1, "wstring": 4}


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


@dataclass(slots=True)
class _Draft:
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
            many = Loop(body, None, field.size) if cell is None else Run(cell, _stride(cell), field.size)
            return ListColumn(draft.add(many), many, item)
        if cell is None:
            loop = Loop(body, field.size)
            return ListColumn(draft.add(loop), loop, item)
        if not field.size:
            return FixedArrayColumn(0, item)
        stride = _stride(cell)
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


def _stride(cell: FixedBlock) -> int:
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
