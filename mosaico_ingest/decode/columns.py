"""Arrow columns built from located values."""

from __future__ import annotations

from typing import cast

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

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
from mosaico_ingest.decode.spans import (
    Array,
    Cells,
    Frame,
    Int64s,
    Located,
    Place,
    Places,
    array_of,
    bytes_at,
    cells,
    expand,
    offsets_of,
    spans,
)
from mosaico_ingest.rosbag.definitions.linking import NUMBERS

__all__ = [
    "build_columns",
    "owners_of",
    "utf8_texts",
    "wide_texts",
]

_ASCII_END = 0x80
_UTF8_STEPS = (0x80, 0x800, 0x10000)
"""The code points from which on UTF-8 takes a byte more."""
_SURROGATES = (0xD800, 0xE000)
_UNICODE_END = 0x110000


def utf8_texts(kind: pa.DataType, sizes: Int64s, data: NDArray[np.uint8]) -> tuple[Array, Int64s]:
    """Return a text of each size, and which of them are not UTF-8."""
    texts = array_of(kind, len(sizes), offsets_of(sizes), data)
    if data.max(initial=0) < _ASCII_END:
        return texts, np.zeros(0, np.int64)
    try:
        texts.validate(full=True)
    except pa.ArrowInvalid:
        return texts, _not_utf8(sizes, data)
    return texts, np.zeros(0, np.int64)


def wide_texts(kind: pa.DataType, counts: Int64s, units: NDArray[np.unsignedinteger]) -> tuple[Array, Int64s]:
    """Return a text of each count of 32-bit units, and which of them are more than one code point a unit."""
    points = units.astype("<u4")
    wrong = ((points >= _SURROGATES[0]) & (points < _SURROGATES[1])) | (points >= _UNICODE_END)
    points[wrong] = 0
    sizes = 1 + sum((points >= step).astype(np.int64) for step in _UTF8_STEPS)
    ends = offsets_of(np.asarray(sizes))
    encoded = np.frombuffer(points.tobytes().decode("utf-32-le").encode(), np.uint8)
    texts = array_of(kind, len(counts), ends[offsets_of(counts)], encoded)
    return texts, np.unique(owners_of(counts, np.flatnonzero(wrong)))


def owners_of(counts: Int64s, which: Int64s) -> Int64s:
    """Return whose element each of `which` is, when owner i has the next `counts[i]` of them."""
    return np.searchsorted(np.cumsum(counts), which, side="right")


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
