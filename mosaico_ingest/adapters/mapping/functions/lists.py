"""Functions of lists."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from mosaico_ingest.adapters.mapping.columns import (
    INT64,
    Array,
    Axis,
    ExprType,
    Mask,
    TypeMismatch,
    arrays,
    expr_type_of,
    field_of,
    format_type,
    int_bounds,
    is_list,
    is_number,
    open_list,
    pc,
    pt,
    struct_of,
    true_mask,
    variable_list,
)
from mosaico_ingest.adapters.mapping.functions.operators import comparable, float_result, integer_result
from mosaico_ingest.adapters.mapping.functions.registry import (
    INTEGER,
    LIST,
    Parameter,
    RejectRows,
    function,
    list_of,
)

NUMBERS = list_of("a list of numbers", is_number)
BOOLEANS = list_of("a list of true and false", pt.is_boolean)
_MOST_ELEMENTS = 2**31 - 1
_NEAR_OVERFLOW = 2.0**62
"""If a sum in floats is below this, the sum of the integers is exact."""


def _count(_: ExprType) -> ExprType:
    return integer_result(0, _MOST_ELEMENTS)


def _len_accepts(expr_type: ExprType) -> bool:
    return any(
        test(expr_type.arrow) for test in (pt.is_list, pt.is_fixed_size_list, pt.is_string, pt.is_binary)
    )


@function(Parameter("a list, text or bytes", _len_accepts), returns=_count)
def len_(x: Array) -> Array:
    """Number of elements of a list, characters of a text, or bytes."""
    if pt.is_string(x.type):
        return pc.cast(pc.utf8_length(x), arrays.int64())
    return pc.cast(pc.binary_length(x) if pt.is_binary(x.type) else pc.list_value_length(x), arrays.int64())


def _element(expr_type: ExprType) -> ExprType:
    return expr_type_of(expr_type.arrow.value_type) if not pt.is_null(expr_type.arrow) else expr_type


def _mean_type(expr_type: ExprType) -> ExprType:
    return float_result(_element(expr_type))


def _total(expr_type: ExprType) -> ExprType:
    element = _element(expr_type)
    return integer_result() if int_bounds(element.arrow) else float_result(element)


def fold(values: NDArray[Any], axis: Axis, run: np.ufunc, empty: Any) -> NDArray[Any]:  # noqa: ANN401 - a number
    """Reduce the elements of each row; `empty` is the result for an empty row."""
    filled = axis.lengths > 0
    result = np.full(len(filled), empty, values.dtype)
    if len(values):
        with np.errstate(all="ignore"):
            result[filled] = run.reduceat(values, axis.offsets[:-1][filled])
    return result


def absent_rows(elements: Array, axis: Axis) -> NDArray[np.bool_]:
    """Return which rows are null or contain a null."""
    absent = np.zeros(len(axis.lengths), bool) if axis.null is None else axis.null.copy()
    if elements.null_count:
        absent[axis.parents[np.asarray(elements.is_null())]] = True
    return absent


def _plain(elements: Array) -> NDArray[Any]:
    """Return the elements as 64-bit numbers, with 0 for null."""
    wide = (
        np.float64
        if not pt.is_integer(elements.type)
        else np.uint64
        if pt.is_uint64(elements.type)
        else np.int64
    )
    return np.asarray(pc.fill_null(elements, 0)).astype(wide)


@function(NUMBERS, returns=_total, name="sum")
def sum_(refuse: RejectRows, x: Array) -> Array:
    """Sum of the elements; 0 for an empty list."""
    elements, axis = open_list(x)
    values = _plain(elements)
    total = fold(values, axis, np.add, 0)
    if values.dtype != np.float64:
        near = np.abs(fold(values.astype(np.float64), axis, np.add, 0)) > _NEAR_OVERFLOW
        for row in np.flatnonzero(near):
            exact = sum(values[axis.offsets[row] : axis.offsets[row + 1]].tolist())
            near[row] = not INT64[0] <= exact <= INT64[1]
        if near.any():
            refuse(near, "overflow", lambda _: "the sum has more than 64 bits")
        total = total.astype(np.int64)
    return arrays.array(total, mask=absent_rows(elements, axis))


@function(NUMBERS, returns=_mean_type)
def mean(x: Array) -> Array:
    """Mean of the elements; null for an empty list."""
    elements, axis = open_list(x)
    total = fold(_plain(elements).astype(np.float64), axis, np.add, 0)
    mask = absent_rows(elements, axis) | (axis.lengths == 0)
    return arrays.array(total / np.maximum(axis.lengths, 1), mask=mask)


def _is_vector(expr_type: ExprType) -> bool:
    if pt.is_struct(expr_type.arrow):
        members = list(expr_type.arrow)
        return bool(members) and all(is_number(member.type) for member in members)
    return NUMBERS.accepts(expr_type)


@function(
    Parameter("a list of numbers, or a message of numbers such as a vector", _is_vector),
    returns=arrays.float64(),
)
def norm(x: Array) -> Array:
    """Euclidean norm of a list or of the fields of a vector or quaternion; null if an element is null."""
    with np.errstate(over="ignore"):  # a norm beyond the range of float64 is infinite
        return _norm(x)


def _norm(x: Array) -> Array:
    if pt.is_struct(x.type):
        members = [pc.cast(field_of(x, member.name), arrays.float64()) for member in x.type]
        absent = np.zeros(len(x), bool)
        total = np.zeros(len(x))
        for member in members:
            absent |= np.asarray(member.is_null())
            total += np.square(np.asarray(pc.fill_null(member, 0.0)))
        return arrays.array(np.sqrt(total), mask=absent)
    elements, axis = open_list(x)
    total = fold(np.square(_plain(elements).astype(np.float64)), axis, np.add, 0.0)
    return arrays.array(np.sqrt(total), mask=absent_rows(elements, axis))


def _extreme(x: Array, run: np.ufunc) -> Array:
    elements, axis = open_list(x)
    values = np.asarray(pc.fill_null(elements, 0))
    mask = absent_rows(elements, axis) | (axis.lengths == 0)
    return arrays.array(fold(values, axis, run, 0), mask=mask)


@function(NUMBERS, returns=_element)
def least(x: Array) -> Array:
    """Smallest element; null for an empty list."""
    return _extreme(x, np.minimum)


@function(NUMBERS, returns=_element)
def greatest(x: Array) -> Array:
    """Largest element; null for an empty list."""
    return _extreme(x, np.maximum)


def _logic(x: Array, run: np.ufunc, empty: bool) -> Array:  # noqa: FBT001 - the neutral element, not a switch
    elements, axis = open_list(x)
    values = np.asarray(pc.fill_null(elements, empty)).astype(bool)
    return arrays.array(fold(values, axis, run, empty), mask=absent_rows(elements, axis))


@function(BOOLEANS, returns=arrays.bool_(), name="any")
def any_(x: Array) -> Array:
    """Whether at least one element is true, as in `any(covariance[] > 0)`; null if an element is null."""
    return _logic(x, np.logical_or, empty=False)


@function(BOOLEANS, returns=arrays.bool_(), name="all")
def all_(x: Array) -> Array:
    """Whether every element is true; null if an element is null."""
    return _logic(x, np.logical_and, empty=True)


def _is_ordered(type_: Any) -> bool:  # noqa: ANN401 - an Arrow type
    return is_number(type_) or pt.is_string(type_) or pt.is_boolean(type_)


def _is_plain(type_: Any) -> bool:  # noqa: ANN401 - an Arrow type
    return _is_ordered(type_) or pt.is_binary(type_)


def _of_elements(parameter: Parameter) -> Parameter:
    return replace(parameter, of_elements=True)


_CONDITIONS = _of_elements(list_of("a condition on each element", pt.is_boolean))
_SORT_KEYS = _of_elements(list_of("a number, text or boolean of each element", _is_ordered))
_KEYS = _of_elements(list_of("a number, text or boolean of each element", _is_plain))
_VALUES = _of_elements(LIST)
_KEY = Parameter("a number, text or boolean", lambda expr_type: _is_plain(expr_type.arrow))


def _element_type(x: ExprType, *_: ExprType) -> ExprType:
    return expr_type_of(x.arrow.value_type, msgtype=x.msgtype)


def _list_type(x: ExprType, *_: ExprType) -> ExprType:
    return ExprType(arrays.list_(x.arrow.value_type), msgtype=x.msgtype)


def _flat_type(x: ExprType) -> ExprType:
    return _list_type(_element_type(x))


def _selected(elements: Array, axis: Axis, keep: Mask) -> Array:
    """Return lists of the elements to keep."""
    if axis.null is not None:
        keep = keep & ~axis.null[axis.parents]
    counts = np.concatenate(([0], np.cumsum(keep)))
    return variable_list(elements.filter(arrays.array(keep)), counts[axis.offsets], axis.null)


def _at_positions(elements: Array, positions: NDArray[np.int64]) -> Array:
    """Return one element per list; a negative position stands for null."""
    return elements.take(arrays.array(np.maximum(positions, 0), mask=positions < 0))


def _local(axis: Axis) -> NDArray[np.int64]:
    """Return the index of each element in its list."""
    return np.arange(axis.offsets[-1]) - axis.offsets[:-1][axis.parents]


def _first(matches: Mask, axis: Axis) -> NDArray[np.int64]:
    """Return the position of the first match in each list, or -1."""
    positions = np.flatnonzero(matches)
    rows, first = np.unique(axis.parents[positions], return_index=True)
    result = np.full(len(axis.lengths), -1, np.int64)
    result[rows] = positions[first]
    return result


@function(LIST, INTEGER, returns=_element_type)
def element(x: Array, index: Array) -> Array:
    """Element at an index, also written `x[index]`; negative indices count from the end; null if it does not exist."""
    elements, axis = open_list(x)
    index = pc.cast(index, arrays.int64(), safe=False)
    values = np.asarray(pc.fill_null(index, 0))
    positions = np.where(values < 0, values + axis.lengths, values)
    absent = (positions < 0) | (positions >= axis.lengths) | np.asarray(index.is_null())
    if axis.null is not None:
        absent |= axis.null
    return _at_positions(elements, np.where(absent, -1, positions + axis.offsets[:-1]))


@function(LIST, INTEGER, INTEGER, returns=_list_type, optional=1)
def slice_(x: Array, start: Array, stop: Array | None = None) -> Array:
    """Elements from start to before stop, also written `x[start:stop]`; negative indices count from the end."""
    elements, axis = open_list(x)
    bounds: list[NDArray[np.int64]] = []
    absent = np.zeros(len(x), bool) if axis.null is None else axis.null.copy()
    for bound in (start, stop):
        if bound is None:
            bounds.append(axis.lengths)
            continue
        absent |= np.asarray(bound.is_null())
        values = np.asarray(pc.fill_null(pc.cast(bound, arrays.int64(), safe=False), 0))
        bounds.append(np.where(values < 0, values + axis.lengths, values))
    local, parents = _local(axis), axis.parents
    keep = (local >= bounds[0][parents]) & (local < bounds[1][parents])
    return _selected(elements, Axis(axis.offsets, absent, axis.size), keep)


@function(LIST, _CONDITIONS, returns=_list_type, name="filter")
def filter_(x: Array, condition: Array) -> Array:
    """Elements for which a condition is true, as in `filter(cells, voltage > 3)`; null counts as false."""
    elements, axis = open_list(x)
    conditions, _ = open_list(condition)
    return _selected(elements, axis, true_mask(conditions))


def _looked_up(_: ExprType, key_field: ExprType, key: ExprType, value_field: ExprType) -> ExprType:
    own = key_field.arrow.value_type
    if own != key.arrow and not (is_number(own) and is_number(key.arrow)):
        raise TypeMismatch(f"the key is {format_type(key)}, the elements have {format_type(own)}", argument=2)
    return _element_type(value_field)


@function(
    LIST,
    _KEYS,
    _KEY,
    _VALUES,
    returns=_looked_up,
)
def lookup(x: Array, key_field: Array, key: Array, value_field: Array) -> Array:
    """Value of the first element with a key, as in `lookup(values, key, 'voltage', value)`; null without such an element."""
    axis = open_list(x)[1]
    keys, elements = open_list(key_field)[0], open_list(value_field)[0]
    matches = true_mask(pc.equal(*comparable(keys, key.take(arrays.array(axis.parents)))))
    if axis.null is not None:
        matches &= ~axis.null[axis.parents]
    return _at_positions(elements, _first(matches, axis))


def _sortable(x: ExprType, keys: ExprType | None = None) -> ExprType:
    if keys is None and not _is_ordered(x.arrow.value_type):
        message = f"the elements are {format_type(_element_type(x))}"
        raise TypeMismatch(message, argument=0, hint="sort them by a field: sort(list, field)")
    return _list_type(x)


@function(LIST, _SORT_KEYS, returns=_sortable, optional=1)
def sort(x: Array, key: Array | None = None) -> Array:
    """Elements in ascending order, or in that of a key, as in `sort(cells, -voltage)`; NaN, then null, come last."""
    elements, axis = open_list(x)
    keys = elements if key is None else open_list(key)[0]
    table = arrays.table({"row": axis.parents, "key": keys})
    order = pc.sort_indices(table, sort_keys=[("row", "ascending"), ("key", "ascending")])
    return _selected(elements.take(order), axis, np.ones(len(elements), bool))


@function(LIST, returns=_list_type)
def reverse(x: Array) -> Array:
    """Elements in the opposite order."""
    elements, axis = open_list(x)
    order = (axis.offsets[:-1] + axis.offsets[1:] - 1)[axis.parents] - np.arange(len(elements))
    return _selected(elements.take(arrays.array(order)), axis, np.ones(len(elements), bool))


@function(list_of("a list of numbers, texts, booleans or bytes", _is_plain), returns=_list_type)
def unique(x: Array) -> Array:
    """Elements without repetitions, in the order of their first occurrence; null equals null, and NaN equals NaN."""
    elements, axis = open_list(x)
    values = pc.add(elements, arrays.scalar(0, elements.type)) if pt.is_floating(elements.type) else elements
    codes = np.asarray(pc.dictionary_encode(values, null_encoding="encode").indices)
    pairs = axis.parents * (codes.max(initial=0) + 1) + codes
    keep = np.zeros(len(elements), bool)
    keep[np.unique(pairs, return_index=True)[1]] = True
    return _selected(elements, axis, keep)


@function(list_of("a list of lists", is_list), returns=_flat_type)
def flatten(x: Array) -> Array:
    """Elements of the lists in a list; a list that is null has no elements."""
    lists, outer = open_list(x)
    elements, inner = open_list(lists)
    keep = np.ones(len(elements), bool)
    if inner.null is not None:
        keep = ~inner.null[inner.parents]
    return _selected(elements, Axis(inner.offsets[outer.offsets], outer.null, None), keep)


def _zipped_type(*lists: ExprType, names: tuple[str, ...]) -> ExprType:
    fields = [arrays.field(name, x.arrow.value_type) for name, x in zip(names, lists, strict=True)]
    return ExprType(arrays.list_(arrays.struct(fields)))


@function(LIST, LIST, returns=_zipped_type, name="zip", variadic=True, named=True)
def zip_(refuse: RejectRows, x: Array, y: Array, *others: Array, names: tuple[str, ...]) -> Array:
    """List of messages with one field per list, named like the list, as in `zip(name, position)[].name`; rejects rows whose lists differ in length."""
    opened = [open_list(values) for values in (x, y, *others)]
    null = np.zeros(len(x), bool)
    for _, axis in opened:
        null |= False if axis.null is None else axis.null
    first = opened[0][1]
    for _, axis in opened[1:]:
        differs = (axis.lengths != first.lengths) & ~null
        if differs.any():
            refuse(differs, "list-length", partial(_length_problem, first.lengths, axis.lengths))
            null |= differs
    lists = [
        open_list(_selected(elements, Axis(axis.offsets, null, None), ~null[axis.parents]))
        for elements, axis in opened
    ]
    columns = [elements for elements, _ in lists]
    type_ = arrays.struct(
        [arrays.field(name, values.type) for name, values in zip(names, columns, strict=True)]
    )
    rows = struct_of(columns, type_, None, len(columns[0]))
    return variable_list(rows, lists[0][1].offsets, null if null.any() else None)


def _length_problem(left: NDArray[np.int64], right: NDArray[np.int64], row: int) -> str:
    return f"lists of {left[row]} and {right[row]} elements"


def _index_type(_: ExprType) -> ExprType:
    return integer_result(0, _MOST_ELEMENTS)


def _position_of(x: Array, run: np.ufunc) -> Array:
    elements, axis = open_list(x)
    values = np.asarray(pc.fill_null(elements, 0))
    extreme = fold(values, axis, run, 0)[axis.parents]
    matches = values == extreme
    if values.dtype.kind == "f":
        matches |= np.isnan(values)
    first = _first(matches, axis)
    absent = absent_rows(elements, axis) | (first < 0)
    return arrays.array(np.where(absent, 0, first - axis.offsets[:-1]), arrays.int64(), mask=absent)


@function(NUMBERS, returns=_index_type)
def argmin(x: Array) -> Array:
    """Index of the first smallest element, the same as `least`; null for an empty list."""
    return _position_of(x, np.minimum)


@function(NUMBERS, returns=_index_type)
def argmax(x: Array) -> Array:
    """Index of the first largest element, the same as `greatest`; null for an empty list."""
    return _position_of(x, np.maximum)
