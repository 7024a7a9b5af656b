"""Functions of numbers, null and NaN."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from mosaico_ingest.adapters.mapping.columns import (
    Array,
    arrays,
    open_list,
    pc,
    promote,
    pt,
    true_mask,
    variable_list,
)
from mosaico_ingest.adapters.mapping.functions.operators import (
    comparable,
    float_result,
    integer_result,
    numbers,
    refuse_nested,
    shifted,
)
from mosaico_ingest.adapters.mapping.functions.registry import (
    ANY,
    FLOAT,
    INTEGER,
    NUMBER,
    RejectRows,
    function,
)
from mosaico_ingest.adapters.mapping.types import ExprType, TypeMismatch, common_type

__all__: list[str] = []


def _joined(*expr_types: ExprType) -> ExprType:
    return common_type(list(expr_types))


def _extreme(*expr_types: ExprType) -> ExprType:
    joined = common_type(list(expr_types))
    return ExprType(arrays.int64(), bounds=joined.bounds) if joined.bounds is not None else joined


def _element_type(expr_type: ExprType, *_: ExprType) -> ExprType:
    return expr_type.element


def _null_if(expr_type: ExprType, value: ExprType) -> ExprType:
    common_type([expr_type, value])
    refuse_nested(expr_type)
    return expr_type.element


@function(ANY, returns=arrays.bool_(), sees_null=True)
def is_null(x: Array) -> Array:
    """Whether x is null; the result is never null."""
    return pc.is_null(x)


@function(ANY, returns=_joined, variadic=True, sees_null=True)
def coalesce(a: Array, *others: Array) -> Array:
    """The first argument that is not null."""
    return pc.coalesce(*promote(a, *others))


@function(ANY, ANY, returns=_null_if)
def null_if(x: Array, value: Array) -> Array:
    """Null if x equals value, else x."""
    same = arrays.array(true_mask(pc.equal(*comparable(x, value))))
    return pc.if_else(same, arrays.scalar(None, x.type), x)


@function(NUMBER, returns=_element_type)
def nan_to_null(x: Array) -> Array:
    """Null if x is NaN, else x."""
    return pc.if_else(pc.is_nan(x), arrays.scalar(None, x.type), x) if pt.is_floating(x.type) else x


def _empty_type(expr_type: ExprType) -> ExprType:
    if not (
        pt.is_string(expr_type.arrow)
        or pt.is_binary(expr_type.arrow)
        or pt.is_list(expr_type.arrow)
        or pt.is_null(expr_type.arrow)
    ):
        raise TypeMismatch("only text, bytes and lists can be empty", argument=0)
    return expr_type.element


@function(ANY, returns=_empty_type)
def empty_to_null(x: Array) -> Array:
    """Null if the text, bytes or list is empty, else x."""
    length = pc.list_value_length(x) if pt.is_list(x.type) else pc.binary_length(x)
    empty = true_mask(pc.equal(length, 0), null=True)
    if not empty.any():
        return x
    if pt.is_list(x.type):
        elements, axis = open_list(x)
        return variable_list(elements, axis.offsets, empty)
    return pc.if_else(arrays.array(empty), arrays.scalar(None, x.type), x)


@function(FLOAT, returns=arrays.bool_())
def is_nan(x: Array) -> Array:
    """Whether x is NaN (not a number)."""
    return pc.is_nan(x)


@function(FLOAT, returns=arrays.bool_())
def is_finite(x: Array) -> Array:
    """Whether x is neither infinite nor NaN."""
    return pc.is_finite(x)


def _magnitude(expr_type: ExprType) -> ExprType:
    if expr_type.bounds is None:
        return float_result(expr_type)
    low, high = expr_type.bounds
    return integer_result(0 if low <= 0 <= high else min(abs(low), abs(high)), max(abs(low), abs(high)))


@function(NUMBER, returns=_magnitude, name="abs")
def abs_(refuse: RejectRows, x: Array) -> Array:
    """Absolute value."""
    (x,) = numbers(refuse, x)
    if not pt.is_integer(x.type):
        return pc.abs(x)
    lowest = true_mask(pc.equal(x, -(2**63)))
    if lowest.any():
        refuse(lowest, "overflow", lambda _: "abs(-2 ** 63) has more than 64 bits")
    return pc.abs(x)


def _sign_type(expr_type: ExprType) -> ExprType:
    return integer_result(-1, 1) if expr_type.bounds is not None else float_result(expr_type)


@function(NUMBER, returns=_sign_type)
def sign(x: Array) -> Array:
    """Sign: -1, 0 or 1."""
    signs = pc.sign(x)
    return pc.cast(signs, arrays.int64()) if pt.is_integer(signs.type) else signs


def _add_float(name: str, run: Any, summary: str) -> None:  # noqa: ANN401 - a pyarrow function
    def apply(x: Array) -> Array:
        return run(x)

    apply.__doc__ = summary
    function(FLOAT, returns=float_result, name=name)(apply)


for _name, _run, _summary in (
    ("sqrt", pc.sqrt, "Square root; NaN below 0."),
    ("exp", pc.exp, "e to the power x."),
    ("log", pc.ln, "Natural logarithm; NaN below 0."),
    ("log10", pc.log10, "Decimal logarithm; NaN below 0."),
    ("sin", pc.sin, "Sine of x rad."),
    ("cos", pc.cos, "Cosine of x rad."),
    ("tan", pc.tan, "Tangent of x rad."),
    ("asin", pc.asin, "Arc sine in rad; NaN outside -1 … 1."),
    ("acos", pc.acos, "Arc cosine in rad; NaN outside -1 … 1."),
    ("atan", pc.atan, "Arc tangent in rad."),
    ("degrees", partial(pc.multiply, 180 / np.pi), "Radians as degrees."),
    ("radians", partial(pc.multiply, np.pi / 180), "Degrees as radians."),
    ("floor", pc.floor, "The whole number below; still a float."),
    ("ceil", pc.ceil, "The whole number above; still a float."),
    ("trunc", pc.trunc, "x without its fraction; still a float."),
    (
        "round",
        partial(pc.round, round_mode="half_to_even"),
        "The nearest whole number, half to even; still a float.",
    ),
):
    _add_float(_name, _run, _summary)


@function(FLOAT, FLOAT, returns=float_result)
def atan2(y: Array, x: Array) -> Array:
    """Angle of the point (x, y) in rad."""
    return pc.atan2(y, x)


@function(FLOAT, FLOAT, returns=float_result)
def hypot(x: Array, y: Array) -> Array:
    """Length of the vector (x, y)."""
    return pc.sqrt(pc.add(pc.multiply(x, x), pc.multiply(y, y)))


@function(NUMBER, NUMBER, returns=_extreme, name="min", variadic=True)
def min_(refuse: RejectRows, a: Array, b: Array, *others: Array) -> Array:
    """Smallest argument; NaN is ignored unless all arguments are NaN."""
    return pc.min_element_wise(*numbers(refuse, a, b, *others), skip_nulls=False)


@function(NUMBER, NUMBER, returns=_extreme, name="max", variadic=True)
def max_(refuse: RejectRows, a: Array, b: Array, *others: Array) -> Array:
    """Largest argument; NaN is ignored unless all arguments are NaN."""
    return pc.max_element_wise(*numbers(refuse, a, b, *others), skip_nulls=False)


@function(NUMBER, NUMBER, NUMBER, returns=_extreme)
def clip(refuse: RejectRows, x: Array, low: Array, high: Array) -> Array:
    """X limited to the range from low to high; NaN stays NaN."""
    x, low, high = numbers(refuse, x, low, high)
    clipped = pc.min_element_wise(pc.max_element_wise(x, low, skip_nulls=False), high, skip_nulls=False)
    return pc.if_else(pc.is_nan(x), x, clipped) if pt.is_floating(x.type) else clipped


@function(INTEGER, INTEGER, returns=arrays.bool_())
def bit(refuse: RejectRows, x: Array, n: Array) -> Array:
    """Whether bit n of an integer is set; the lowest is bit 0; rejects rows with n outside of 0 … 63."""
    return pc.equal(pc.bit_wise_and(shifted(refuse, ">>", x, n), 1), 1)
