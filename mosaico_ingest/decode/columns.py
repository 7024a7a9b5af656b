"""Arrow columns built from located values."""

from __future__ import annotations

from typing import cast

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from mosaico_ingest.decode.layout import (
    Column,
    FixedArrayColumn,
    FixedBlock,
    Layout,
    ListColumn,
    Loop,
    NumberColumn,
    Run,
    Step,
    StructColumn,
    TextColumn,
)
from mosaico_ingest.decode.spans import (
    Array,
    BodyOffsets,
    Cells,
    Int64s,
    LocatedMessages,
    Payloads,
    StepOffsets,
    array_of,
    bytes_at,
    copy_slices,
    expand_ranges,
    fixed_cells,
    list_offsets,
)
from mosaico_ingest.rosbag.definitions.linking import NUMBERS

_ASCII_END = 0x80
_UTF8_STEPS = (0x80, 0x800, 0x10000)
"""Code points from which UTF-8 needs one more byte."""
_SURROGATES = (0xD800, 0xE000)
_UNICODE_END = 0x110000


def utf8_texts(kind: pa.DataType, sizes: Int64s, data: NDArray[np.uint8]) -> tuple[Array, Int64s]:
    """Return strings of the given sizes in bytes, and the indices of strings that are not UTF-8."""
    texts = array_of(kind, len(sizes), list_offsets(sizes), data)
    if data.max(initial=0) < _ASCII_END:
        return texts, np.zeros(0, np.int64)
    try:
        texts.validate(full=True)
    except pa.ArrowInvalid:
        return texts, _not_utf8(sizes, data)
    return texts, np.zeros(0, np.int64)


def wide_texts(kind: pa.DataType, counts: Int64s, units: NDArray[np.unsignedinteger]) -> tuple[Array, Int64s]:
    """Return strings of the given counts of 32-bit units, and the indices of those with invalid or surrogate units."""
    points = units.astype("<u4")
    wrong = ((points >= _SURROGATES[0]) & (points < _SURROGATES[1])) | (points >= _UNICODE_END)
    points[wrong] = 0
    sizes = 1 + sum((points >= step).astype(np.int64) for step in _UTF8_STEPS)
    ends = list_offsets(np.asarray(sizes))
    encoded = np.frombuffer(points.tobytes().decode("utf-32-le").encode(), np.uint8)
    texts = array_of(kind, len(counts), ends[list_offsets(counts)], encoded)
    return texts, np.unique(owners_of(counts, np.flatnonzero(wrong)))


def owners_of(counts: Int64s, elements: Int64s) -> Int64s:
    """Return the owner of each element number, if owner i has the next `counts[i]` elements."""
    return np.searchsorted(np.cumsum(counts), elements, side="right")


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


def build_columns(
    layout: Layout, shape: pa.StructType, payloads: Payloads, located: LocatedMessages
) -> tuple[pa.StructArray, Int64s]:
    """Return one row per located message, and the positions of the rows with invalid texts, which need `RowwiseDecoder`."""
    builder = _Builder(payloads)
    root = _Instances(layout.body.steps, located.offsets, len(located.rows))
    rows = builder.column(layout.record, shape, root, root.count)
    # The stubs cannot express that an array of a struct type is a StructArray.
    return cast("pa.StructArray", rows), builder.invalid_rows


class _Instances:
    """The m instances of a body: the messages, or the elements of a list. `owners` maps elements to messages."""

    __slots__ = ("blocks", "count", "offsets", "owners", "steps")

    def __init__(
        self, steps: tuple[Step, ...], offsets: BodyOffsets, count: int, owners: tuple[Int64s, ...] = ()
    ) -> None:
        self.steps = steps
        self.offsets = offsets
        self.count = count
        self.owners = owners
        self.blocks: dict[int, Cells] = {}
        """The bytes of each fixed-size block, gathered once for all columns in it."""

    def messages(self, instances: Int64s) -> Int64s:
        """Return the position of the message that each instance belongs to."""
        for counts in reversed(self.owners):
            instances = owners_of(counts, instances)
        return instances


class _Builder:
    """Builds the columns of one set of payloads."""

    __slots__ = ("_data", "_order", "invalid_rows")

    def __init__(self, payloads: Payloads) -> None:
        self._data = payloads.data
        self._order = payloads.order
        self.invalid_rows = np.zeros(0, np.int64)

    def column(self, column: Column, kind: pa.DataType, inst: _Instances, count: int) -> Array:
        """Return `count` values: one per instance, times the sizes of the fixed arrays around the column."""
        if not count:
            return pa.nulls(0, kind)  # type: ignore[call-overload]  # the stubs restrict it to extension types
        match column:
            case NumberColumn():
                return self._numbers(column, kind, inst)
            case TextColumn():
                return self._texts(column, kind, inst)
            case FixedArrayColumn(count=size, item=item):
                values = self.column(item, kind.field(0).type, inst, count * size)
                return array_of(kind, count, children=[values])
            case ListColumn():
                return self._items(column, kind, inst)
            case StructColumn(children=children):
                arrays = [
                    self.column(child, kind.field(number).type, inst, count)
                    for number, child in enumerate(children)
                ]
                return array_of(kind, count, children=arrays)

    def _numbers(self, column: NumberColumn, kind: pa.DataType, inst: _Instances) -> Array:
        number = np.dtype(f"{self._order}{'u1' if column.type == 'bool' else NUMBERS[column.type]}")
        view = self._block(inst, column.step).numbers(number, column.offset, column.dims)
        if column.type == "bool":
            return array_of(kind, view.size, np.packbits(view != 0, bitorder="little"))
        flags = view.flags
        if not (flags.c_contiguous and flags.aligned and number.isnative):
            view = view.astype(number.newbyteorder("="), order="C")
        return array_of(kind, view.size, view)

    def _block(self, inst: _Instances, number: int) -> Cells:
        if number not in inst.blocks:
            step = inst.steps[number]
            size = step.size if isinstance(step, FixedBlock) else 0
            inst.blocks[number] = fixed_cells(self._data, inst.offsets[number].at, size)
        return inst.blocks[number]

    def _items(self, column: ListColumn, kind: pa.DataType, inst: _Instances) -> Array:
        offsets = inst.offsets[column.step]
        if pa.types.is_binary(kind):
            data = copy_slices(self._data, offsets.at, offsets.counts)
            return array_of(kind, inst.count, list_offsets(offsets.counts), data)
        inner = self._elements(column.of, offsets, inst)
        values = self.column(column.item, kind.field(0).type, inner, inner.count)
        if pa.types.is_fixed_size_list(kind):
            return array_of(kind, inst.count, children=[values])
        return array_of(kind, inst.count, list_offsets(offsets.counts), children=[values])

    def _elements(self, of: Run | Loop, offsets: StepOffsets, inst: _Instances) -> _Instances:
        """Return the elements of a list; those of a run are instances of a body that consists of one block."""
        counts = offsets.counts
        total = int(counts.sum())
        if isinstance(of, Loop):
            return _Instances(of.body.steps, offsets.body, total, (*inst.owners, counts))
        size = of.cell.size
        if of.stride > size or not size:
            return _Instances((of.cell,), (StepOffsets(expand_ranges(offsets.at, counts, of.stride)),), total)
        inner = _Instances((of.cell,), (offsets,), total)
        inner.blocks[0] = Cells(copy_slices(self._data, offsets.at, counts * size), total, size)
        return inner

    def _texts(self, column: TextColumn, kind: pa.DataType, inst: _Instances) -> Array:
        text, offsets = column.text, inst.offsets[column.step]
        sizes = self._without_nul(inst, offsets) if text.has_nul else offsets.counts * text.unit
        data = copy_slices(self._data, offsets.at, sizes)
        if text.unit == 1:
            texts, wrong = utf8_texts(kind, sizes, data)
        else:
            texts, wrong = wide_texts(kind, offsets.counts, data.view(f"{self._order}u{text.unit}"))
        self._add_invalid(inst, wrong)
        return texts

    def _without_nul(self, inst: _Instances, offsets: StepOffsets) -> Int64s:
        """Return the sizes of texts without their terminating NUL; a text of size 0 has none."""
        sizes = np.maximum(offsets.counts - 1, 0)
        last = bytes_at(self._data, np.maximum(offsets.at + offsets.counts - 1, 0))
        open_ended = (last != 0) & (offsets.counts > 0)
        self._add_invalid(inst, np.flatnonzero(open_ended))
        return sizes

    def _add_invalid(self, inst: _Instances, wrong: Int64s) -> None:
        """Mark the messages of some instances as rows for the row-wise decoder."""
        if len(wrong):
            self.invalid_rows = np.union1d(self.invalid_rows, inst.messages(wrong))
