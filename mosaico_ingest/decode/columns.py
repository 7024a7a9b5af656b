"""This file builds the Arrow columns of located messages."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from mosaico_ingest.decode.arrow import NUMBERS
from mosaico_ingest.decode.gather import cells, spans
from mosaico_ingest.decode.layout import (
    Block,
    Column,
    Grid,
    Items,
    Layout,
    Leaf,
    Loop,
    Record,
    Run,
    Step,
    Text,
    Words,
)
from mosaico_ingest.decode.places import Frame, Int64s, Located, Place, Places, expand

__all__ = ["build_columns"]

_ASCII_END = 0x80
_SURROGATES = (0xD800, 0xE000)
_UNICODE_END = 0x110000


def build_columns(
    layout: Layout, shape: pa.StructType, frame: Frame, located: Located
) -> tuple[pa.StructArray, Int64s]:
    """Return one row a located message, and the positions of the rows whose texts are not Unicode."""
    builder = _Builder(frame)
    root = _Instances(layout.body.steps, located.places, len(located.rows), ())
    rows = builder.column(layout.record, shape, root, root.count)
    return rows, np.unique(np.concatenate([np.zeros(0, np.int64), *builder.unreadable]))


class _Instances:
    """The m instances of a body whose columns are built; `owners` leads back to the messages they belong to."""

    __slots__ = ("_cells", "count", "owners", "places", "steps")

    def __init__(
        self,
        steps: tuple[Step, ...],
        places: Places,
        count: int,
        owners: tuple[Int64s, ...],
        cell: NDArray[np.uint8] | None = None,
    ) -> None:
        self.steps = steps
        self.places = places
        self.count = count
        self.owners = owners
        self._cells = {} if cell is None else {0: cell}

    def block(self, data: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
        """Return the bytes of a block, shape (m, size), gathered once for all columns in it."""
        if step not in self._cells:
            block = self.steps[step]
            size = block.size if isinstance(block, Block) else 0
            self._cells[step] = cells(data, self.places[step].at, size)
        return self._cells[step]

    def messages(self, which: Int64s) -> Int64s:
        """Return the position of the message each of some instances belongs to."""
        for counts in reversed(self.owners):
            which = _owner(counts, which)
        return which


class _Builder:
    __slots__ = ("_data", "_order", "unreadable")

    def __init__(self, frame: Frame) -> None:
        self._data = frame.data
        self._order = frame.order
        self.unreadable: list[Int64s] = []

    def column(self, column: Column, shape: pa.DataType, inst: _Instances, count: int) -> pa.Array:
        """Return `count` values: one for each instance, or one for each place in the grids around it."""
        if not count:
            return pa.array([], shape)
        match column:
            case Leaf():
                return self._leaf(column, shape, inst)
            case Words(step=step):
                return self._text(shape, inst, step)
            case Grid(count=size, item=item):
                values = self.column(item, shape.value_type, inst, count * size)
                return pa.Array.from_buffers(shape, count, [None], children=[values])
            case Items():
                return self._items(column, shape, inst)
            case Record(children=children):
                kinds = [shape.field(number).type for number in range(shape.num_fields)]
                arrays = [self.column(*child, inst, count) for child in zip(children, kinds, strict=True)]
                return pa.Array.from_buffers(shape, count, [None], children=arrays)

    def _leaf(self, leaf: Leaf, shape: pa.DataType, inst: _Instances) -> pa.Array:
        block = inst.block(self._data, leaf.step)
        counts, strides = zip(*leaf.dims, strict=True) if leaf.dims else ((), ())
        kind = np.dtype(f"{self._order}{'u1' if leaf.type == 'bool' else NUMBERS[leaf.type]}")
        view = np.ndarray((len(block), *counts), kind, block, leaf.offset, (block.shape[1], *strides))
        if leaf.type == "bool":
            return pa.array((view != 0).reshape(-1))
        values = np.require(view, kind.newbyteorder("="), ["C_CONTIGUOUS", "ALIGNED"])
        return pa.Array.from_buffers(shape, values.size, [None, pa.py_buffer(values)])

    def _items(self, items: Items, shape: pa.DataType, inst: _Instances) -> pa.Array:
        step, place = inst.steps[items.step], inst.places[items.step]
        counts = place.counts
        if isinstance(step, Loop):
            inner = _Instances(step.body.steps, place.body, int(counts.sum()), (*inst.owners, counts))
        else:
            inner = self._cells(step, place)
            if pa.types.is_binary(shape):
                return _ragged(shape, counts, inner.block(self._data, 0))
        values = self.column(items.item, shape.value_type, inner, inner.count)
        if pa.types.is_fixed_size_list(shape):
            return pa.Array.from_buffers(shape, len(counts), [None], children=[values])
        return pa.Array.from_buffers(
            shape, len(counts), [None, pa.py_buffer(_offsets(counts))], children=[values]
        )

    def _cells(self, run: Run, place: Place) -> _Instances:
        """Return the cells of a run as instances of a body that is one block."""
        counts, size = place.counts, run.cell.size
        total = int(counts.sum())
        if size and run.stride == size:
            cell = spans(self._data, place.at, counts * size).reshape(total, size)
            return _Instances((run.cell,), (place,), total, (), cell)
        return _Instances((run.cell,), (Place(expand(place.at, counts, run.stride)),), total, ())

    def _text(self, shape: pa.DataType, inst: _Instances, step: int) -> pa.Array:
        place = inst.places[step]
        sizes, text = place.counts, spans(self._data, place.at, place.counts)
        unit = inst.steps[step]
        if isinstance(unit, Text) and unit.unit > 1:
            return self._wide_text(shape, inst, sizes // unit.unit, text)
        array = _ragged(shape, sizes, text)
        if text.max(initial=0) >= _ASCII_END:
            try:
                array.validate(full=True)
            except pa.ArrowInvalid:
                self.unreadable.append(inst.messages(_not_utf8(array, text)))
        return array

    def _wide_text(
        self, shape: pa.DataType, inst: _Instances, counts: Int64s, text: NDArray[np.uint8]
    ) -> pa.Array:
        """Return texts whose every unit is a code point; pairs of surrogates are left to the row-wise decoder."""
        points = text.view(f"{self._order}u4").astype("<u4")
        wrong = ((points >= _SURROGATES[0]) & (points < _SURROGATES[1])) | (points >= _UNICODE_END)
        if wrong.any():
            self.unreadable.append(inst.messages(_owner(counts, np.flatnonzero(wrong))))
            points[wrong] = 0
        widths = 1 + (points >= 0x80).astype(np.int32) + (points >= 0x800) + (points >= 0x10000)  # noqa: PLR2004 - UTF-8
        ends = np.concatenate([[0], np.cumsum(widths)]).astype(np.int32)
        encoded = points.tobytes().decode("utf-32-le").encode()
        buffers = [None, pa.py_buffer(ends[_offsets(counts)]), pa.py_buffer(encoded)]
        return pa.Array.from_buffers(shape, len(counts), buffers)


def _offsets(counts: Int64s) -> NDArray[np.int32]:
    offsets = np.zeros(len(counts) + 1, np.int32)
    np.cumsum(counts, out=offsets[1:])
    return offsets


def _ragged(shape: pa.DataType, sizes: Int64s, values: NDArray[np.uint8]) -> pa.Array:
    buffers = [None, pa.py_buffer(_offsets(sizes)), pa.py_buffer(values)]
    return pa.Array.from_buffers(shape, len(sizes), buffers)


def _owner(counts: Int64s, which: Int64s) -> Int64s:
    """Return whose element each of `which` is, when owner i has the next `counts[i]` of them."""
    return np.searchsorted(np.cumsum(counts), which, side="right")


def _not_utf8(array: pa.Array, text: NDArray[np.uint8]) -> Int64s:
    """Return the positions of the values that are not UTF-8."""
    sizes = np.diff(np.frombuffer(array.buffers()[1], np.int32)[: len(array) + 1]).astype(np.int64)
    suspects = np.unique(_owner(sizes, np.flatnonzero(text >= _ASCII_END)))
    values = array.cast(pa.binary())
    return np.array([row for row in suspects.tolist() if not _is_utf8(values[row].as_py())], np.int64)


def _is_utf8(value: bytes) -> bool:
    try:
        value.decode()
    except UnicodeDecodeError:
        return False
    return True
