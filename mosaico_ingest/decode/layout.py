"""This file resolves a definition once: the steps that walk a message, and where each column lies among them.

A message is walked in *steps*. Values of fixed size that follow each other are one `Block`, whatever the
structs they belong to, because their distances do not depend on the message; only texts and sequences are
steps of their own. The *columns* are the tree of the Arrow type, its leaves pointing into the steps.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.rosbag.blocks import Encoding
from mosaico_ingest.rosbag.definitions.linking import NUMBERS, TEXTS
from mosaico_ingest.rosbag.definitions.model import (
    Container,
    Definition,
    Field,
    MessageType,
)

__all__ = [
    "PADDING",
    "WORD",
    "ZEROS",
    "Block",
    "Body",
    "Column",
    "Grid",
    "Items",
    "Layout",
    "Leaf",
    "Loop",
    "Record",
    "Run",
    "Step",
    "Text",
    "Words",
    "compile_layout",
    "least_bytes",
]

WORD = 4
"""Bytes of a length word."""
PADDING, ZEROS = 3, 7
"""Bytes that CDR may leave behind a message, and that it may if they are zero."""
_MAX_ALIGN = 8
_UNITS = {"string": 1, "wstring": 4}


class Block(Struct, frozen=True):
    """`size` bytes that start at a multiple of `align`."""

    align: int
    size: int


class Text(Struct, frozen=True):
    """A length word and that many units of text."""

    unit: int
    """Bytes of a unit: 1 for `string`, 4 for `wstring`."""
    closed: bool = False
    """Whether a NUL ends the text and is counted, as in a CDR `string`."""


class Run(Struct, frozen=True):
    """A length word and that many cells, one every `stride` bytes."""

    cell: Block
    stride: int
    bound: int = 0
    """The most elements there may be; 0: any number."""


class Loop(Struct, frozen=True):
    """Elements that have to be walked one after the other."""

    body: Body
    count: int | None
    """None: a length word says, and `bound` limits it as in a run."""
    bound: int = 0


Step: TypeAlias = Block | Text | Run | Loop


class Body(Struct, frozen=True):
    """The steps of one message or element."""

    steps: tuple[Step, ...]
    least: int
    """Bytes an instance has at least, alignment apart."""


class Leaf(Struct, frozen=True):
    """A number in a block; `dims` are (count, stride) of the fixed arrays around it within the block."""

    step: int
    offset: int
    type: str
    dims: tuple[tuple[int, int], ...] = ()


class Words(Struct, frozen=True):
    """A text."""

    step: int
    text: Text


class Grid(Struct, frozen=True):
    """A fixed array within a block."""

    count: int
    item: Column


class Items(Struct, frozen=True):
    """The elements of a run or a loop; the leaves of `item` point into the cell or the body."""

    step: int
    of: Run | Loop
    item: Column


class Record(Struct, frozen=True):
    """A struct."""

    children: tuple[Column, ...]


Column: TypeAlias = Leaf | Words | Grid | Items | Record


class Layout(Struct, frozen=True):
    """How the messages of one definition are walked, and the columns they become."""

    encoding: Encoding
    body: Body
    record: Record


def compile_layout(definition: Definition, encoding: Encoding) -> Layout:
    """Resolve a definition whose `ros_shape` exists."""
    compiler = _Compiler(definition, aligned=encoding is Encoding.CDR)
    # A message starts at a multiple of the largest alignment: nothing in front can move its first block.
    draft = _Draft(open_block=Block(_MAX_ALIGN, 0))
    record = compiler.struct(definition.message, draft)
    return Layout(encoding, draft.body(), record)


@dataclass(slots=True)
class _Draft:
    """The steps found so far; the last may be a block that still grows."""

    steps: list[Step] = field(default_factory=list[Step])
    open_block: Block | None = None

    def place(self, align: int, size: int) -> tuple[int, int]:
        """Add `size` bytes and return their step and the offset in its block."""
        block = self.open_block
        if block is None or align > block.align:
            self.close()
            block = Block(align, 0)
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

    def struct(self, message: MessageType, draft: _Draft) -> Record:
        if self.aligned and not message.fields:
            draft.place(1, 1)  # CDR has no empty struct: a byte without meaning stands for it
        return Record(tuple(self._field(field, draft) for field in message.fields))

    def _field(self, field: Field, draft: _Draft) -> Column:
        if field.container is Container.SCALAR:
            return self._item(field, draft)
        inner = _Draft()
        item = self._item(field, inner)
        body = inner.body()
        cell = _single_block(body)
        if field.container is Container.SEQUENCE:
            many = Loop(body, None, field.size) if cell is None else Run(cell, _stride(cell), field.size)
            return Items(draft.add(many), many, item)
        if cell is None:
            loop = Loop(body, field.size)
            return Items(draft.add(loop), loop, item)
        if not field.size:
            return Grid(0, item)
        stride = _stride(cell)
        step, offset = draft.place(cell.align, stride * (field.size - 1) + cell.size)
        return Grid(field.size, _moved(item, step, offset, (field.size, stride)))

    def _item(self, field: Field, draft: _Draft) -> Column:
        if field.is_message:
            return self.struct(self.definition.types[field.type], draft)
        if field.type in TEXTS:
            text = Text(_UNITS[field.type], closed=self.aligned and field.type == "string")
            return Words(draft.add(text), text)
        size = np.dtype(NUMBERS[field.type]).itemsize
        step, offset = draft.place(size if self.aligned else 1, size)
        return Leaf(step, offset, field.type)


def least_bytes(step: Step) -> int:
    """Return how many bytes each thing that a step counts takes at least; 1 where it could be none."""
    match step:
        case Text(unit=unit):
            return unit
        case Run(cell=cell):
            return max(cell.size, 1)
        case Loop(body=body):
            return max(body.least, 1)
        case Block():
            return 1


def _single_block(body: Body) -> Block | None:
    """Return the only block of a body whose instances are all of one size."""
    if not body.steps:
        return Block(1, 0)
    first = body.steps[0]
    return first if len(body.steps) == 1 and isinstance(first, Block) else None


def _stride(cell: Block) -> int:
    return -(-cell.size // cell.align) * cell.align


def _least(step: Step) -> int:
    match step:
        case Block(size=size):
            return size
        case Loop(body=body, count=int(count)):
            return count * body.least
        case _:
            return WORD


def _moved(column: Column, step: int, offset: int, dim: tuple[int, int]) -> Column:
    """Return a column of a cell as a column of the block the cell's array lies in."""
    match column:
        case Leaf():
            return Leaf(step, column.offset + offset, column.type, (dim, *column.dims))
        case Grid():
            return Grid(column.count, _moved(column.item, step, offset, dim))
        case Record():
            return Record(tuple(_moved(child, step, offset, dim) for child in column.children))
        case _:
            return column
