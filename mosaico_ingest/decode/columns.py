"""This file builds the Arrow columns of located messages."""

from __future__ import annotations

from typing import cast

import numpy as np
import pyarrow as pa

from mosaico_ingest.bag.shape import NUMBERS
from mosaico_ingest.decode.gather import Array, Cells, array_of, bytes_at, cells, offsets_of, spans
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
    Words,
)
from mosaico_ingest.decode.places import Frame, Int64s, Located, Place, Places, expand
from mosaico_ingest.decode.texts import owners_of, utf8_texts, wide_texts

__all__ = ["build_columns"]


def build_columns(
    layout: Layout, shape: pa.StructType, frame: Frame, located: Located
) -> tuple[pa.StructArray, Int64s]:
    """Return one row a located message, and the positions of those whose texts could not be read here."""
    builder = _Builder(frame)
    root = _Instances(layout.body.steps, located.places, len(located.rows))
    rows = builder.column(layout.record, shape, root, root.count)
    # A record of a struct's type is an array of structs, which the stubs cannot know.
    return cast("pa.StructArray", rows), builder.unread


class _Instances:
    """The m instances of a body whose columns are built; `owners` leads back to the messages they belong to."""

    __slots__ = ("blocks", "count", "owners", "places", "steps")

    def __init__(
        self, steps: tuple[Step, ...], places: Places, count: int, owners: tuple[Int64s, ...] = ()
    ) -> None:
        self.steps = steps
        self.places = places
        self.count = count
        self.owners = owners
        self.blocks: dict[int, Cells] = {}
        """The bytes of blocks, one each: gathered once for all columns that lie in one."""

    def messages(self, which: Int64s) -> Int64s:
        """Return the position of the message each of some instances belongs to."""
        for counts in reversed(self.owners):
            which = owners_of(counts, which)
        return which


class _Builder:
    """Builds the columns of one frame."""

    __slots__ = ("_data", "_order", "unread")

    def __init__(self, frame: Frame) -> None:
        self._data = frame.data
        self._order = frame.order
        self.unread = np.zeros(0, np.int64)

    def column(self, column: Column, kind: pa.DataType, inst: _Instances, count: int) -> Array:
        """Return `count` values: one for each instance, or one for each place in the grids around it."""
        if not count:
            return pa.nulls(0, kind)  # type: ignore[call-overload]  # the stubs know it for extension types only
        match column:
            case Leaf():
                return self._leaf(column, kind, inst)
            case Words():
                return self._texts(column, kind, inst)
            case Grid(count=size, item=item):
                values = self.column(item, kind.field(0).type, inst, count * size)
                return array_of(kind, count, children=[values])
            case Items():
                return self._items(column, kind, inst)
            case Record(children=children):
                arrays = [
                    self.column(child, kind.field(number).type, inst, count)
                    for number, child in enumerate(children)
                ]
                return array_of(kind, count, children=arrays)

    def _leaf(self, leaf: Leaf, kind: pa.DataType, inst: _Instances) -> Array:
        number = np.dtype(f"{self._order}{'u1' if leaf.type == 'bool' else NUMBERS[leaf.type]}")
        view = self._block(inst, leaf.step).numbers(number, leaf.offset, leaf.dims)
        if leaf.type == "bool":
            return array_of(kind, view.size, np.packbits(view != 0, bitorder="little"))
        flags = view.flags
        if not (flags.c_contiguous and flags.aligned and number.isnative):
            view = view.astype(number.newbyteorder("="), order="C")
        return array_of(kind, view.size, view)

    def _block(self, inst: _Instances, number: int) -> Cells:
        if number not in inst.blocks:
            step = inst.steps[number]
            size = step.size if isinstance(step, Block) else 0
            inst.blocks[number] = cells(self._data, inst.places[number].at, size)
        return inst.blocks[number]

    def _items(self, items: Items, kind: pa.DataType, inst: _Instances) -> Array:
        place = inst.places[items.step]
        if pa.types.is_binary(kind):
            data = spans(self._data, place.at, place.counts)
            return array_of(kind, inst.count, offsets_of(place.counts), data)
        inner = self._elements(items.of, place, inst)
        values = self.column(items.item, kind.field(0).type, inner, inner.count)
        if pa.types.is_fixed_size_list(kind):
            return array_of(kind, inst.count, children=[values])
        return array_of(kind, inst.count, offsets_of(place.counts), children=[values])

    def _elements(self, of: Run | Loop, place: Place, inst: _Instances) -> _Instances:
        """Return the elements of a loop; those of a run are instances of a body that is one block."""
        counts = place.counts
        total = int(counts.sum())
        if isinstance(of, Loop):
            return _Instances(of.body.steps, place.body, total, (*inst.owners, counts))
        size = of.cell.size
        if of.stride > size or not size:
            return _Instances((of.cell,), (Place(expand(place.at, counts, of.stride)),), total)
        inner = _Instances((of.cell,), (place,), total)
        inner.blocks[0] = Cells(spans(self._data, place.at, counts * size), total, size)
        return inner

    def _texts(self, words: Words, kind: pa.DataType, inst: _Instances) -> Array:
        text, place = words.text, inst.places[words.step]
        sizes = self._without_nul(inst, place) if text.closed else place.counts * text.unit
        data = spans(self._data, place.at, sizes)
        if text.unit == 1:
            texts, wrong = utf8_texts(kind, sizes, data)
        else:
            texts, wrong = wide_texts(kind, place.counts, data.view(f"{self._order}u{text.unit}"))
        self._leave(inst, wrong)
        return texts

    def _without_nul(self, inst: _Instances, place: Place) -> Int64s:
        """Return the sizes of texts without the NUL that ends them; one of size 0 has none."""
        sizes = np.maximum(place.counts - 1, 0)
        last = bytes_at(self._data, np.maximum(place.at + place.counts - 1, 0))
        open_ended = (last != 0) & (place.counts > 0)
        self._leave(inst, np.flatnonzero(open_ended))
        return sizes

    def _leave(self, inst: _Instances, wrong: Int64s) -> None:
        """Leave the messages of some instances to the row-wise decoder."""
        if len(wrong):
            self.unread = np.union1d(self.unread, inst.messages(wrong))
