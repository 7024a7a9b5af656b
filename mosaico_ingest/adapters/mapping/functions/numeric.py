"""Functions of numbers, null and NaN."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from mosaico_ingest.adapters.mapping.columns import (
    Array,
    arrays,
    one_type,
    open_list,
    pc,
    pt,
    true_where,
    var_list,
)
from mosaico_ingest.adapters.mapping.functions.operators import (
    comparable,
    computed,
    numbers,
    whole,
)
from mosaico_ingest.adapters.mapping.functions.registry import (
    ANY,
    FLOAT,
    NUMBER,
    Refuse,
    function,
)
from mosaico_ingest.adapters.mapping.types import Kind, Unfit, join

__all__: list[str] = []


def _joined(*kinds: Kind) -> Kind:
    return join(list(kinds))


def _extreme(*kinds: Kind) -> Kind:
    joined = join(list(kinds))
    return Kind(arrays.int64(), bounds=joined.bounds) if joined.bounds is not None else joined


def _element_kind(kind: Kind, *_: Kind) -> Kind:
    return kind.element


def _null_if(kind: Kind, value: Kind) -> Kind:
    join([kind, value])
    return kind.element


@function(ANY, gives=arrays.bool_(), sees_null=True)
def is_null(x: Array) -> Array:
    """Whether there is no value; never null itself."""
    return pc.is_null(x)


@function(ANY, gives=_joined, variadic=True, sees_null=True)
def coalesce(a: Array, *others: Array) -> Array:
    """The first that is not null."""
    return pc.coalesce(*one_type(a, *others))


@function(ANY, ANY, gives=_null_if)
def null_if(x: Array, value: Array) -> Array:
    """Null where x equals value."""
    same = arrays.array(true_where(pc.equal(*comparable(x, value))))
    return pc.if_else(same, arrays.scalar(None, x.type), x)


@function(NUMBER, gives=_element_kind)
def nan_to_null(x: Array) -> Array:
    """Null where x is NaN."""
    return pc.if_else(pc.is_nan(x), arrays.scalar(None, x.type), x) if pt.is_floating(x.type) else x


def _empty_kind(kind: Kind) -> Kind:
    if not (
        pt.is_string(kind.type) or pt.is_binary(kind.type) or pt.is_list(kind.type) or pt.is_null(kind.type)
    ):
        raise Unfit("only text, bytes and lists can be empty", argument=0)
    return kind.element


@function(ANY, gives=_empty_kind)
def empty_to_null(x: Array) -> Array:
    """Null where the text, bytes or list is empty."""
    length = pc.list_value_length(x) if pt.is_list(x.type) else pc.binary_length(x)
    empty = true_where(pc.equal(length, 0), null=True)
    if not empty.any():
        return x
    if pt.is_list(x.type):
        elements, axis = open_list(x)
        return var_list(elements, axis.offsets, empty)
    return pc.if_else(arrays.array(empty), arrays.scalar(None, x.type), x)


@function(FLOAT, gives=arrays.bool_())
def is_nan(x: Array) -> Array:
    """Whether x is not a number (NaN)."""
    return pc.is_nan(x)


@function(FLOAT, gives=arrays.bool_())
def is_finite(x: Array) -> Array:
    """Whether x is neither infinite nor NaN."""
    return pc.is_finite(x)


def _magnitude(kind: Kind) -> Kind:
    if kind.bounds is None:
        return computed(kind)
    low, high = kind.bounds
    return whole(0 if low <= 0 <= high else min(abs(low), abs(high)), max(abs(low), abs(high)))


@function(NUMBER, gives=_magnitude, name="abs")
def abs_(refuse: Refuse, x: Array) -> Array:
    """Magnitude."""
    (x,) = numbers(refuse, x)
    if not pt.is_integer(x.type):
        return pc.abs(x)
    lowest = true_where(pc.equal(x, -(2**63)))
    if lowest.any():
        refuse(lowest, "overflow", lambda _: "abs(-2 ** 63) has more than 64 bits")
    return pc.abs(x)


def _sign_kind(kind: Kind) -> Kind:
    return whole(-1, 1) if kind.bounds is not None else computed(kind)


@function(NUMBER, gives=_sign_kind)
def sign(x: Array) -> Array:
    """-1, 0 or 1."""
    signs = pc.sign(x)
    return pc.cast(signs, arrays.int64()) if pt.is_integer(signs.type) else signs


def _add_float(name: str, run: Any, summary: str) -> None:  # noqa: ANN401 - a pyarrow function
    def apply(x: Array) -> Array:
        return run(x)

    apply.__doc__ = summary
    function(FLOAT, gives=computed, name=name)(apply)


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


@function(FLOAT, FLOAT, gives=computed)
def atan2(y: Array, x: Array) -> Array:
    """Angle of the point (x, y) in rad."""
    return pc.atan2(y, x)


@function(FLOAT, FLOAT, gives=computed)
def hypot(x: Array, y: Array) -> Array:
    """Length of the vector (x, y)."""
    return pc.sqrt(pc.add(pc.multiply(x, x), pc.multiply(y, y)))


@function(NUMBER, NUMBER, gives=_extreme, name="min", variadic=True)
def min_(refuse: Refuse, a: Array, b: Array, *others: Array) -> Array:
    """Smallest of the arguments; one that is NaN is passed over."""
    return pc.min_element_wise(*numbers(refuse, a, b, *others), skip_nulls=False)


@function(NUMBER, NUMBER, gives=_extreme, name="max", variadic=True)
def max_(refuse: Refuse, a: Array, b: Array, *others: Array) -> Array:
    """Largest of the arguments; one that is NaN is passed over."""
    return pc.max_element_wise(*numbers(refuse, a, b, *others), skip_nulls=False)


@function(NUMBER, NUMBER, NUMBER, gives=_extreme)
def clip(refuse: Refuse, x: Array, low: Array, high: Array) -> Array:
    """The value, brought within the bounds; NaN stays NaN."""
    x, low, high = numbers(refuse, x, low, high)
    clipped = pc.min_element_wise(pc.max_element_wise(x, low, skip_nulls=False), high, skip_nulls=False)
    return pc.if_else(pc.is_nan(x), x, clipped) if pt.is_floating(x.type) else clipped
