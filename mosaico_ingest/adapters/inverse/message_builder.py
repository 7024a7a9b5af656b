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
    is_list,
    null_mask,
    open_list,
    pc,
    pt,
    struct_of,
    variable_list,
)
from mosaico_ingest.adapters.mapping.loader import ReadPath

CLOUD_FUNCTIONS: Mapping[str, tuple[str, int]] = {
    "points_float32": ("<f4", 7),
    "points_float64": ("<f8", 8),
    "points_uint8": ("u1", 2),
    "points_uint16": ("<u2", 4),
    "points_packed": ("<f4", 7),
}
"""For each function, the numpy type of the points and the `datatype` of PointField."""


class CloudField(Struct, frozen=True):
    """One field of the points of every row."""

    name: str
    function: str
    values: Array
    """Lists with one element per point; null if the cloud has no such field."""


def pack_clouds(fields: Sequence[CloudField], rows: int) -> Array:
    """Return clouds without their headers, one per row."""
    opened = [(field, *open_list(field.values)) for field in fields]
    flat = [np.asarray(elements).astype(CLOUD_FUNCTIONS[field.function][0]) for field, elements, _ in opened]
    clouds: list[dict[str, Any]] = []
    for row in range(rows):
        present = [
            (field, values[axis.offsets[row] : axis.offsets[row + 1]])
            for (field, _, axis), values in zip(opened, flat, strict=True)
            if axis.null is None or not axis.null[row]
        ]
        clouds.append(_cloud(present))
    return arrays.array(clouds, _CLOUD)


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
    "nsec": "nanoseconds",
    "nanos": "nanoseconds",
}
"""The names in the ontology of the fields of headers and times."""


class _Constraint(Struct, frozen=True):
    """A value that a field, or one element of its list, must have in some rows; applies where the field is unknown."""

    index: int | None
    """The index of the list element; None for the value itself."""
    where: Mask
    value: Any
    """One value for all rows, or an array with one value per row."""

    def of(self, rows: Any) -> Any:  # noqa: ANN401 - numpy's positions, a field's values
        """Return the values of some rows."""
        return self.value[rows] if isinstance(self.value, np.ndarray) else self.value


class Presence(Struct, frozen=True):
    """Which fields of messages can be absent, as in protobuf and JSON."""

    required: frozenset[ReadPath]
    """The fields that every message has."""
    absent: frozenset[ReadPath]
    """The fields that are absent in all messages."""


class MessageBuilder:
    """Builds a batch of messages from field values; the first non-null value of a field is kept.

    With a `presence`, fields that are assigned with `keeps_null` keep their nulls unless they are required, and a nested
    message is absent where all its values are null.
    """

    def __init__(self, shape: DataType, rows: int, presence: Presence | None = None) -> None:
        self._shape = shape
        self._rows = rows
        self.presence = presence
        self._keep_null: set[FieldPath] = set()
        self._values: dict[FieldPath, Array] = {}
        self._axes: dict[FieldPath, Axis] = {}
        self._constraints: dict[FieldPath, list[_Constraint]] = defaultdict(list)
        self.defaulted: list[str] = []
        """The fields without a value, such as `header.seq`, which `build` filled with defaults or left absent."""

    def assign(
        self, path: FieldPath, values: Array, axes: tuple[Axis, ...] = (), *, keeps_null: bool = False
    ) -> None:
        """Set a field: one value per row, or one per element of the lists around it."""
        type_ = self.type_at(path)
        if pt.is_struct(type_):
            self._put_fields(path, type_, values, axes, keeps_null=keeps_null)
        elif is_list(type_) and pt.is_struct(type_.value_type):
            elements, axis = open_list(values)
            if keeps_null and self._is_optional(path):
                self._keep_null.add(path)
            self.assign((*path, EACH_ELEMENT), elements, (*axes, axis), keeps_null=keeps_null)
        else:
            lists = [at for at, name in enumerate(path) if name == EACH_ELEMENT]
            for at, axis in zip(lists, axes, strict=True):
                self._axes.setdefault(path[:at], axis)
            current = self._values.get(path)
            self._values[path] = values if current is None else _coalesce(current, values)
            if keeps_null and self._is_optional(path):
                self._keep_null.add(path)

    def constrain(self, path: FieldPath, index: int | None, where: Mask, value: Any) -> None:  # noqa: ANN401 - a field's value
        """Record the value that a field, or one of its elements, must have in some rows if nothing else is known."""
        self._constraints[path].append(_Constraint(index, where, value))

    def type_at(self, path: FieldPath) -> DataType:
        """Return the type of a field of the message."""
        type_ = self._shape
        for name in path:
            type_ = type_.value_type if name == EACH_ELEMENT else type_.field(name).type
        return type_

    def build(self) -> Array:
        """Return the messages."""
        self.defaulted.clear()
        return self._struct(self._shape, (), self._rows)

    def _put_fields(
        self,
        path: FieldPath,
        type_: DataType,
        values: Array,
        axes: tuple[Axis, ...],
        *,
        keeps_null: bool,
    ) -> None:
        present = {field.name for field in values.type}
        for field in type_:
            source_name = field.name if field.name in present else _ONTOLOGY_NAMES.get(field.name)
            if source_name in present:
                self.assign(
                    (*path, field.name), field_of(values, str(source_name)), axes, keeps_null=keeps_null
                )

    def _struct(self, type_: DataType, path: FieldPath, rows: int) -> Array:
        children = [self._field(field.type, (*path, field.name), rows) for field in type_]
        return struct_of(children, type_, self._absent(path), rows)

    def _absent(self, path: FieldPath) -> Mask | None:
        """Return where a nested message is absent: all its assigned values are null, and one of them keeps nulls."""
        below = [each for each in self._values if each[: len(path)] == path and each != path]
        if not path or path[-1] == EACH_ELEMENT or self._keep_null.isdisjoint(below):
            return None
        masks = [self._null_below(path, each) for each in below]
        present = [mask for mask in masks if mask is not None]
        return np.logical_and.reduce(present) if len(present) == len(masks) else None

    def _null_below(self, path: FieldPath, assigned: FieldPath) -> Mask | None:
        """Return where an assigned field of a nested message, or the list that contains it, is null."""
        if EACH_ELEMENT not in assigned[len(path) :]:
            return null_mask(self._values[assigned])
        return self._axes[assigned[: assigned.index(EACH_ELEMENT, len(path))]].null

    def _field(self, type_: DataType, path: FieldPath, rows: int) -> Array:
        if self.presence is not None and _read_path(path) in self.presence.absent:
            self._add_defaulted(path)
            return arrays.nulls(rows, type_)
        if pt.is_struct(type_):
            return self._struct(type_, path, rows)
        if path in self._axes:
            axis = self._axes[path]
            elements = self._field(type_.value_type, (*path, EACH_ELEMENT), int(axis.offsets[-1]))
            absent = axis.null if path in self._keep_null else None
            variable = variable_list(elements, axis.offsets, absent, arrays.list_(type_.value_field))
            return _of_size(variable, type_) if pt.is_fixed_size_list(type_) else variable
        values = self._values.get(path)
        if values is not None and path in self._keep_null and path not in self._constraints:
            return _with_nulls(values, type_)
        if values is None and path not in self._constraints:
            self._add_defaulted(path)
        array = zeros(type_, rows) if values is None else fill_nulls(values, type_)
        absent = np.ones(rows, bool) if values is None else null_mask(values)
        return array if absent is None else self._apply_constraints(array, path, absent)

    def _is_optional(self, path: FieldPath) -> bool:
        return self.presence is not None and _read_path(path) not in self.presence.required

    def _add_defaulted(self, path: FieldPath) -> None:
        self.defaulted.append(".".join(path).replace(f".{EACH_ELEMENT}", EACH_ELEMENT))

    def _apply_constraints(self, array: Array, path: FieldPath, absent: Mask) -> Array:
        for constraint in self._constraints.get(path, ()):
            rows = np.flatnonzero(constraint.where & absent)
            if not len(rows):
                continue
            if constraint.index is None:
                array = _with_values(array, rows, constraint.of(rows))
                continue
            elements, axis = open_list(array)
            rows = rows[axis.lengths[rows] > constraint.index]
            new_elements = _with_values(
                elements, axis.offsets[:-1][rows] + constraint.index, constraint.of(rows)
            )
            array = axis.close(new_elements, array.type)
        return array


def _read_path(path: FieldPath) -> ReadPath:
    return tuple(name for name in path if name != EACH_ELEMENT)


def zeros(type_: DataType, rows: int) -> Array:
    """Return an array of zeros, empty texts and empty lists."""
    if pt.is_struct(type_):
        return struct_of([zeros(field.type, rows) for field in type_], type_, None, rows)
    if pt.is_fixed_size_list(type_):
        return fixed_list(zeros(type_.value_type, rows * type_.list_size), type_.list_size, None, rows, type_)
    if pt.is_list(type_):
        return variable_list(zeros(type_.value_type, 0), np.zeros(rows + 1, np.int64), None, type_)
    return arrays.repeat(_zero(type_), rows)


def fill_nulls(values: Array, type_: DataType) -> Array:
    """Cast values to the type of a field, with zero for null."""
    if pt.is_null(values.type):
        return zeros(type_, len(values))
    if is_list(type_):
        elements, axis = open_list(values)
        variable = variable_list(
            fill_nulls(elements, type_.value_type), axis.offsets, None, arrays.list_(type_.value_field)
        )
        return _of_size(variable, type_) if pt.is_fixed_size_list(type_) else variable
    if values.type != type_:
        if pt.is_integer(type_) and pt.is_floating(values.type):
            values = pc.round(values)
        values = pc.cast(values, type_, safe=False)
    return pc.fill_null(values, _zero(type_)) if values.null_count else values


def _with_nulls(values: Array, type_: DataType) -> Array:
    """Cast values to the type of a field; nulls stay null."""
    array = fill_nulls(values, type_)
    absent = null_mask(values)
    return array if absent is None else pc.if_else(arrays.array(absent), arrays.scalar(None, type_), array)


def _coalesce(current: Array, more: Array) -> Array:
    """Return the first array, with nulls replaced from the second."""
    if not current.null_count or pt.is_nested(current.type) or len(current) != len(more):
        return current
    return pc.coalesce(current, pc.cast(more, current.type, safe=False))


def _zero(type_: DataType) -> Any:  # noqa: ANN401 - an Arrow scalar
    variable = (
        "" if pt.is_string(type_) else b"" if pt.is_binary(type_) else False if pt.is_boolean(type_) else 0
    )
    return arrays.scalar(variable, type_)


def _of_size(array: Array, type_: DataType) -> Array:
    """Convert lists to a fixed length; lists of another length become zeros."""
    elements, axis = open_list(array)
    size, fits = type_.list_size, axis.lengths == type_.list_size
    if not fits.all():
        positions = (axis.offsets[:-1, None] + np.arange(size)).ravel()
        absent = np.repeat(~fits, size)
        padded = elements.take(arrays.array(np.where(absent, 0, positions), mask=absent))
        elements = fill_nulls(padded, type_.value_type) if not pt.is_struct(type_.value_type) else padded
    return fixed_list(elements, size, None, len(array), type_)


def _with_values(array: Array, positions: Any, value: Any) -> Array:  # noqa: ANN401 - numpy's, and a field's value
    values = np.array(array)
    values[positions] = value
    return arrays.array(values, array.type)
