"""Functions over the elements of a list."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mosaico_ingest.adapters.mapping.columns import Array, Axis, arrays, field_of, open_list, pc, pt
from mosaico_ingest.adapters.mapping.functions.operators import float_result, integer_result
from mosaico_ingest.adapters.mapping.functions.registry import Parameter, RejectRows, function, list_of
from mosaico_ingest.adapters.mapping.types import INT64, ExprType, expr_type_of, int_bounds, is_number

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
