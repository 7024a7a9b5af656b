"""Assemble messages from field values, including packed point clouds."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from msgspec import Struct

from mosaico_ingest.adapters.mapping.columns import (
    Array,
    Axis,
    DataType,
    Mask,
    arrays,
    field_of,
    fixed_list,
    null_mask,
    open_list,
    pc,
    pt,
    struct_of,
    variable_list,
)
from mosaico_ingest.adapters.mapping.types import is_list

__all__ = [
    "CLOUD_FUNCTIONS",
    "EACH_ELEMENT",
    "CloudField",
    "FieldPath",
    "MessageBuilder",
    "pack_clouds",
]

CLOUD_FUNCTIONS: Mapping[str, tuple[str, int]] = {
    "points_float32": ("<f4", 7),
    "points_float64": ("<f8", 8),
    "points_uint8": ("u1", 2),
    "points_uint16": ("<u2", 4),
    "points_packed": ("<f4", 7),
}
"""What a function reads from a cloud: numpy's name of it, and the number PointField has for it."""


class CloudField(Struct, frozen=True):
    """A field of the points of every row."""

    name: str
    function: str
    values: Array
    """Lists, one element a point; null where the cloud has no such field."""


def pack_clouds(fields: Sequence[CloudField], rows: int) -> Array:
    """Return what a cloud is made of, without its header, one a row."""
    opened = [(field, *open_list(field.values)) for field in fields]
    flat = [np.asarray(elements).astype(CLOUD_FUNCTIONS[field.function][0]) for field, elements, _ in opened]
    made: list[dict[str, Any]] = []
    for row in range(rows):
        there = [
            (field, values[axis.offsets[row] : axis.offsets[row + 1]])
            for (field, _, axis), values in zip(opened, flat, strict=True)
            if axis.null is None or not axis.null[row]
        ]
        made.append(_cloud(there))
    return arrays.array(made, _CLOUD)


def _cloud(fields: Sequence[tuple[CloudField, Any]]) -> dict[str, Any]:
    points = max((len(values) for _, values in fields), default=0)
    layout: Any = np.dtype([(field.name, CLOUD_FUNCTIONS[field.function][0]) for field, _ in fields])
    packed: Any = np.zeros(points, layout)
    for field, values in fields:
        packed[field.name][: len(values)] = values
    entries = [
        {
            "name": field.name,
            "offset": int(layout.fields[field.name][1]),
            "datatype": CLOUD_FUNCTIONS[field.function][1],
            "count": 1,
        }
        for field, _ in fields
    ]
    step = layout.itemsize
    return {
        "height": 1,
        "width": points,
        "fields": entries,
        "is_bigendian": False,
        "point_step": step,
        "row_step": step * points,
        "data": packed.tobytes(),
        "is_dense": all(bool(np.isfinite(values).all()) for _, values in fields),
    }


_FIELD = arrays.struct(
    [
        ("name", arrays.string()),
        ("offset", arrays.uint32()),
        ("datatype", arrays.uint8()),
        ("count", arrays.uint32()),
    ]
)
_CLOUD = arrays.struct(
    [
        ("height", arrays.uint32()),
        ("width", arrays.uint32()),
        ("fields", arrays.list_(_FIELD)),
        ("is_bigendian", arrays.bool_()),
        ("point_step", arrays.uint32()),
        ("row_step", arrays.uint32()),
        ("data", arrays.binary()),
        ("is_dense", arrays.bool_()),
    ]
)

FieldPath: TypeAlias = "tuple[str, ...]"
"""The names that lead to a field; `[]` stands for each element of a list."""
EACH_ELEMENT = "[]"
_ONTOLOGY_NAMES = {
    "stamp": "timestamp",
    "seq": "sample_counter",
    "sec": "seconds",
    "nanosec": "nanoseconds",
}
"""What the ontology calls the fields of a header and of a time."""


class _Constraint(Struct, frozen=True):
    """A value that a field, or one element of its list, must have had in some rows; used where the field itself is not known."""

    index: int | None
    """Which element of the list; None: the value itself."""
    where: Mask
    value: Any
    """One for all rows, or an array of one a row."""

    def of(self, rows: Any) -> Any:  # noqa: ANN401 - numpy's positions, a field's values
        """Return the values of some rows."""
        return self.value[rows] if isinstance(self.value, np.ndarray) else self.value


class MessageBuilder:
    """The fields of a batch of messages, as they become known; what was put first stays, where it is not null."""

    def __init__(self, shape: DataType, rows: int) -> None:
        self._shape = shape
        self._rows = rows
        self._values: dict[FieldPath, Array] = {}
        self._axes: dict[FieldPath, Axis] = {}
        self._marks: dict[FieldPath, list[_Constraint]] = defaultdict(list)
        self.defaulted: list[str] = []
        """The fields that `build` had to make up, as `header.seq`."""

    def assign(self, place: FieldPath, values: Array, axes: tuple[Axis, ...] = ()) -> None:
        """Say what a field is: one value a row, or one an element of the lists around it."""
        kind = self.type_at(place)
        if pt.is_struct(kind):
            self._put_fields(place, kind, values, axes)
        elif is_list(kind) and pt.is_struct(kind.value_type):
            elements, axis = open_list(values)
            self.assign((*place, EACH_ELEMENT), elements, (*axes, axis))
        else:
            lists = [at for at, name in enumerate(place) if name == EACH_ELEMENT]
            for at, axis in zip(lists, axes, strict=True):
                self._axes.setdefault(place[:at], axis)
            known = self._values.get(place)
            self._values[place] = values if known is None else _either(known, values)

    def constrain(self, place: FieldPath, index: int | None, where: Mask, value: Any) -> None:  # noqa: ANN401 - a field's value
        """Say what a field, or an element of it, must have been in some rows, unless more is known of it."""
        self._marks[place].append(_Constraint(index, where, value))

    def type_at(self, place: FieldPath) -> DataType:
        """Return the type of a field of the message."""
        kind = self._shape
        for name in place:
            kind = kind.value_type if name == EACH_ELEMENT else kind.field(name).type
        return kind

    def build(self) -> Array:
        """Return the messages."""
        self.defaulted.clear()
        return self._struct(self._shape, (), self._rows)

    def _put_fields(self, place: FieldPath, kind: DataType, values: Array, axes: tuple[Axis, ...]) -> None:
        there = {field.name for field in values.type}
        for field in kind:
            own = field.name if field.name in there else _ONTOLOGY_NAMES.get(field.name)
            if own in there:
                self.assign((*place, field.name), field_of(values, str(own)), axes)

    def _struct(self, kind: DataType, place: FieldPath, rows: int) -> Array:
        children = [self._field(field.type, (*place, field.name), rows) for field in kind]
        return struct_of(children, kind, None, rows)

    def _field(self, kind: DataType, place: FieldPath, rows: int) -> Array:
        if pt.is_struct(kind):
            return self._struct(kind, place, rows)
        if place in self._axes:
            axis = self._axes[place]
            elements = self._field(kind.value_type, (*place, EACH_ELEMENT), int(axis.offsets[-1]))
            plain = variable_list(elements, axis.offsets, None, arrays.list_(kind.value_field))
            return _of_size(plain, kind) if pt.is_fixed_size_list(kind) else plain
        values = self._values.get(place)
        if values is None and place not in self._marks:
            self.defaulted.append(".".join(place).replace(f".{EACH_ELEMENT}", EACH_ELEMENT))
        array = zeros(kind, rows) if values is None else fill_nulls(values, kind)
        absent = np.ones(rows, bool) if values is None else null_mask(values)
        return array if absent is None else self._marked(array, place, absent)

    def _marked(self, array: Array, place: FieldPath, absent: Mask) -> Array:
        for mark in self._marks.get(place, ()):
            rows = np.flatnonzero(mark.where & absent)
            if not len(rows):
                continue
            if mark.index is None:
                array = _with(array, rows, mark.of(rows))
                continue
            elements, axis = open_list(array)
            rows = rows[axis.lengths[rows] > mark.index]
            changed = _with(elements, axis.offsets[:-1][rows] + mark.index, mark.of(rows))
            array = axis.close(changed, array.type)
        return array


def zeros(kind: DataType, rows: int) -> Array:
    """Return an array of zeros, empty texts and lists."""
    if pt.is_struct(kind):
        return struct_of([zeros(field.type, rows) for field in kind], kind, None, rows)
    if pt.is_fixed_size_list(kind):
        return fixed_list(zeros(kind.value_type, rows * kind.list_size), kind.list_size, None, rows, kind)
    if pt.is_list(kind):
        return variable_list(zeros(kind.value_type, 0), np.zeros(rows + 1, np.int64), None, kind)
    return arrays.repeat(_zero(kind), rows)


def fill_nulls(values: Array, kind: DataType) -> Array:
    """Return values in a field's type, the field's zero where there is none."""
    if pt.is_null(values.type):
        return zeros(kind, len(values))
    if is_list(kind):
        elements, axis = open_list(values)
        plain = variable_list(
            fill_nulls(elements, kind.value_type), axis.offsets, None, arrays.list_(kind.value_field)
        )
        return _of_size(plain, kind) if pt.is_fixed_size_list(kind) else plain
    if values.type != kind:
        if pt.is_integer(kind) and pt.is_floating(values.type):
            values = pc.round(values)
        values = pc.cast(values, kind, safe=False)
    return pc.fill_null(values, _zero(kind)) if values.null_count else values


def _either(known: Array, more: Array) -> Array:
    """Return what is known, and more where it is null."""
    if not known.null_count or pt.is_nested(known.type) or len(known) != len(more):
        return known
    return pc.coalesce(known, pc.cast(more, known.type, safe=False))


def _zero(kind: DataType) -> Any:  # noqa: ANN401 - an Arrow scalar
    plain = "" if pt.is_string(kind) else b"" if pt.is_binary(kind) else False if pt.is_boolean(kind) else 0
    return arrays.scalar(plain, kind)


def _of_size(array: Array, kind: DataType) -> Array:
    """Return lists as lists of a fixed length: those of another length become zeros."""
    elements, axis = open_list(array)
    size, good = kind.list_size, axis.lengths == kind.list_size
    if not good.all():
        positions = (axis.offsets[:-1, None] + np.arange(size)).ravel()
        absent = np.repeat(~good, size)
        taken = elements.take(arrays.array(np.where(absent, 0, positions), mask=absent))
        elements = fill_nulls(taken, kind.value_type) if not pt.is_struct(kind.value_type) else taken
    return fixed_list(elements, size, None, len(array), kind)


def _with(array: Array, positions: Any, value: Any) -> Array:  # noqa: ANN401 - numpy's, and a field's value
    values = np.array(array)
    values[positions] = value
    return arrays.array(values, array.type)
