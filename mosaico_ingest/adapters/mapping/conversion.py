"""Conversion to the exact types of ontology columns: the static check, and the cast of the values."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mosaico_ingest.adapters.mapping.columns import (
    Array,
    Axis,
    DataType,
    ExprType,
    Mask,
    TypeMismatch,
    arrays,
    exact_float,
    expr_type_of,
    fixed_list,
    format_type,
    int_bounds,
    is_list,
    is_number,
    null_mask,
    open_list,
    pc,
    pt,
    struct_of,
    variable_list,
    within,
)
from mosaico_ingest.adapters.mapping.functions.registry import RejectRows, set_null
from mosaico_ingest.adapters.mapping.functions.ros import HEADER_TYPE, STAMP_TYPE, as_header, as_stamp


def element_type(target: DataType, axes: tuple[int | None, ...]) -> DataType:
    """Return the type that the elements of open lists must have for a column.

    Raises:
        Unfit: The target has fewer lists, or lists of another length.
    """
    for size in axes:
        if not is_list(target):
            raise TypeMismatch(
                f"a list does not fit {format_type(target)}",
                hint="select one element with a[0], or reduce the list with len, sum, mean, least or greatest",
            )
        if size is not None and pt.is_fixed_size_list(target) and target.list_size != size:
            raise TypeMismatch(f"a list of {size} for one of {target.list_size}")
        target = target.value_type
    return target


def check_fits(expr_type: ExprType, target: DataType) -> None:
    """Check that every value of a type fits a column.

    Raises:
        Unfit: Some value may not.
    """
    _check(expr_type.element, element_type(target, expr_type.axes))


def _check(expr_type: ExprType, target: DataType) -> None:
    source = expr_type.arrow
    if source == target or pt.is_null(source):
        return
    if is_list(source) and is_list(target):
        if pt.is_fixed_size_list(source) and pt.is_fixed_size_list(target):
            element_type(target, (source.list_size,))
        _check(expr_type_of(source.value_type, msgtype=expr_type.msgtype), target.value_type)
    elif pt.is_struct(source) and pt.is_struct(target):
        _check_fields(expr_type, target)
    elif not (is_number(source) and is_number(target) and _always_fits(expr_type, target)):
        raise TypeMismatch(_mismatch(expr_type, target), hint=_hint(source, target))


def _always_fits(expr_type: ExprType, target: DataType) -> bool:
    if pt.is_integer(target):
        return expr_type.bounds is not None and within(expr_type.bounds, int_bounds(target))
    return exact_float(expr_type).bit_width <= target.bit_width


def _mismatch(expr_type: ExprType, target: DataType) -> str:
    if not (is_number(expr_type.arrow) and is_number(target)):
        return f"{format_type(expr_type)} for {format_type(target)}"
    if expr_type.bounds is None or expr_type.bounds == int_bounds(expr_type.arrow):
        return f"{format_type(expr_type)} may not fit {format_type(target)}"
    low, high = expr_type.bounds
    if low == high:
        return f"{low} does not fit {format_type(target)}"
    return f"{format_type(expr_type)} from {low} to {high} may not fit {format_type(target)}"


def _hint(source: DataType, target: DataType) -> str | None:
    """Return the hint for an incompatible pair of types."""
    computes = is_number(source) or pt.is_boolean(source)
    if computes and (is_number(target) or pt.is_boolean(target)):
        first = "round(x) first, then " if pt.is_floating(source) and pt.is_integer(target) else ""
        return f"{first}cast(…) if the values fit; rows with other values are rejected"
    if pt.is_string(target):
        return "convert it with text(…)" if computes else None
    if is_number(target) and pt.is_string(source):
        return "parse it with cast(number(…))"
    if pt.is_binary(target) and is_list(source):
        return "convert a list of uint8 with bytes(…)"
    if is_list(target) and not is_list(source):
        return "write [x] for a list of one element" if computes else None
    return "select one of its fields" if pt.is_struct(source) else None


def _check_fields(expr_type: ExprType, target: DataType) -> None:
    if _special_conversion(expr_type.arrow, target) is not None:
        return
    names = {field.name for field in target}
    extra = [field.name for field in expr_type.arrow if field.name not in names]
    if extra:
        raise TypeMismatch(
            f"{format_type(expr_type)} has {', '.join(extra)}, which {format_type(target)} has not",
            hint="list the fields with {of: …, fields: {…}}, or use another adapter with {use: …, of: …}",
        )
    for field in target:
        position = expr_type.arrow.get_field_index(field.name)
        if position >= 0:
            _check(expr_type_of(expr_type.arrow.field(position).type), field.type)
        elif not field.nullable:
            raise TypeMismatch(
                f"{format_type(expr_type)} has no {field.name}, which {format_type(target)} requires"
            )


def _special_conversion(source: DataType, target: DataType) -> Callable[[RejectRows, Array], Array] | None:
    """Return the conversion to a header or time stamp, None for any other struct."""
    if target == HEADER_TYPE and {field.name for field in source} >= {"stamp", "frame_id"}:
        return as_header
    if target == STAMP_TYPE and {field.name for field in source} in _TIMES:
        return as_stamp
    return None


_TIMES = ({"sec", "nanosec"}, {"sec", "nsec"}, {"seconds", "nanos"})
"""The fields of times in ROS, Foxglove's JSON and `google.protobuf.Timestamp`."""


def convert(array: Array, target: DataType, refuse: RejectRows) -> Array:
    """Cast a column to exactly the target type, without copying if it already has that layout."""
    if array.type == target:
        return array
    if pt.is_null(array.type):
        return arrays.nulls(len(array), target)
    if is_list(target):
        return _convert_list(array, target, refuse)
    if pt.is_struct(target):
        return _convert_struct(array, target, refuse)
    return to_number(array, target, refuse)


def _convert_list(array: Array, target: DataType, refuse: RejectRows) -> Array:
    elements, axis = open_list(array)
    if pt.is_fixed_size_list(target) and axis.size is None:
        size = target.list_size
        wrong = axis.lengths != size
        if axis.null is not None:
            wrong &= ~axis.null
        if wrong.any():
            refuse(wrong, "list-length", lambda i: f"the list has {axis.lengths[i]} elements, not {size}")
        elements, axis = _with_fixed_size(elements, axis, size)
    values = convert(elements, target.value_type, _rejecting_rows_of(axis, refuse))
    if pt.is_fixed_size_list(target):
        return fixed_list(values, target.list_size, axis.null, len(array), target)
    return variable_list(values, axis.offsets, axis.null, target)


def _with_fixed_size(elements: Array, axis: Axis, size: int) -> tuple[Array, Axis]:
    """Return `size` elements for every row, with nulls as the elements of null lists."""
    fits = axis.lengths == size
    offsets = np.arange(len(fits) + 1, dtype=np.int64) * size
    if fits.all():
        return elements, Axis(offsets, axis.null, size)
    positions = (axis.offsets[:-1, None] + np.arange(size)).ravel()
    absent = np.repeat(~fits, size)
    padded = elements.take(arrays.array(np.where(absent, 0, positions), mask=absent))
    return padded, Axis(offsets, ~fits, size)


def _rejecting_rows_of(axis: Axis, refuse: RejectRows) -> RejectRows:
    """Return a callback that rejects rows by the elements of their lists."""

    def reject_elements(bad: Mask, rule: str, reason: Callable[[int], str]) -> None:
        rows, first = np.unique(axis.parents[bad], return_index=True)
        positions = dict(zip(rows.tolist(), np.flatnonzero(bad)[first].tolist(), strict=True))
        mask = np.zeros(len(axis.lengths), bool)
        mask[rows] = True
        refuse(
            mask,
            rule,
            lambda row: f"element {positions[row] - int(axis.offsets[row])}: {reason(positions[row])}",
        )

    return reject_elements


def _convert_struct(array: Array, target: DataType, refuse: RejectRows) -> Array:
    conversion = _special_conversion(array.type, target)
    if conversion is not None:
        return conversion(refuse, array)
    absent = null_mask(array)
    children: list[Array] = []
    for field in target:
        position = array.type.get_field_index(field.name)
        child = arrays.nulls(len(array), field.type) if position < 0 else array.field(position)
        child = convert(child, field.type, _naming_field(field.name, refuse))
        children.append(
            child if field.nullable else refuse_nulls(child, absent, _naming_field(field.name, refuse))
        )
    return struct_of(children, target, absent, len(array))


def _naming_field(name: str, refuse: RejectRows) -> RejectRows:
    def reject_named(bad: Mask, rule: str, reason: Callable[[int], str]) -> None:
        refuse(bad, rule, lambda i: f"{name}: {reason(i)}")

    return reject_named


def refuse_nulls(array: Array, parent_null: Mask | None, refuse: RejectRows) -> Array:
    """Reject rows without a required value, except where the enclosing struct is null."""
    absent = null_mask(array)
    if absent is None:
        return array
    bad = absent if parent_null is None else absent & ~parent_null
    if bad.any():
        refuse(bad, "null", lambda _: "null, but the ontology requires a value")
    return _filled(array, absent)


def _filled(array: Array, absent: Mask) -> Array:
    """Replace nulls with an arbitrary value; the enclosing struct is null there, so the value is invisible."""
    present = np.flatnonzero(~absent)
    if not len(present):
        return _zeros(array.type, len(array))
    positions = np.where(absent, present[0], np.arange(len(array)))
    return array.take(arrays.array(positions))


def _zeros(type_: DataType, length: int) -> Array:
    """Return an array of arbitrary values without nulls."""
    if pt.is_struct(type_):
        return struct_of([_zeros(field.type, length) for field in type_], type_, None, length)
    if pt.is_fixed_size_list(type_):
        return fixed_list(
            _zeros(type_.value_type, length * type_.list_size), type_.list_size, None, length, type_
        )
    if pt.is_list(type_):
        return variable_list(_zeros(type_.value_type, 0), np.zeros(length + 1, np.int64), None, type_)
    plain = "" if pt.is_string(type_) else b"" if pt.is_binary(type_) else 0
    return (
        arrays.array([plain] * length, type_) if type_ != arrays.bool_() else arrays.array([False] * length)
    )


def to_number(array: Array, target: DataType, refuse: RejectRows) -> Array:
    """Cast numbers to another type; a value out of range rejects its row."""
    if array.type == target:
        return array
    bad = _out_of_range(array, target)
    if bad is not None and bad.any():
        refuse(bad, "out-of-range", lambda i: f"{array[i].as_py()} does not fit {format_type(target)}")
        array = set_null(array, bad)
    return pc.cast(array, target, safe=False)


def _out_of_range(array: Array, target: DataType) -> Mask | None:
    """Return which numbers are out of range, None if none can be."""
    if pt.is_boolean(array.type) or pt.is_null(array.type) or target == arrays.float64():
        return None
    values = np.asarray(pc.fill_null(array, 0))
    if pt.is_boolean(target):
        return (values != 0) & (values != 1)
    bounds = int_bounds(target)
    if bounds is None:
        return _too_large(values, target)
    if values.dtype.kind == "f":
        # `bounds[1] + 1` is exact as a float; 2 ** 63 - 1 is not.
        return ~(
            (values >= float(bounds[0])) & (values < float(bounds[1] + 1)) & (values == np.trunc(values))
        )
    own = int_bounds(array.type)
    if own is not None and within(own, bounds):
        return None
    low, high = max(bounds[0], own[0] if own else 0), min(bounds[1], own[1] if own else 0)
    return (values < values.dtype.type(low)) | (values > values.dtype.type(high))


def _too_large(values: NDArray[Any], target: DataType) -> Mask | None:
    """Return which floats become infinite in a narrower type."""
    if values.dtype.kind != "f" or values.dtype.itemsize * 8 <= target.bit_width:
        return None
    with np.errstate(over="ignore"):
        narrow = values.astype(np.float32 if target.bit_width == 32 else np.float16)  # noqa: PLR2004 - bits
    return np.isinf(narrow) & ~np.isinf(values)
