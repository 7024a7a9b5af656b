"""Operators: arithmetic, comparison, logic."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from msgspec.structs import replace

from mosaico_ingest.adapters.mapping.columns import (
    INT64,
    Array,
    ExprType,
    Mask,
    TypeMismatch,
    arrays,
    format_type,
    is_number,
    null_mask,
    pc,
    pt,
    true_mask,
    widest_float,
)
from mosaico_ingest.adapters.mapping.functions.registry import (
    ANY,
    BOOLEAN,
    FLOAT,
    INTEGER,
    NUMBER,
    Parameter,
    RejectRows,
    function,
    set_null,
)

_MOST_BITS = 64


def float_result(*expr_types: ExprType) -> ExprType:
    """Return the type of a float result: as wide as the widest float field among the operands."""
    return ExprType(widest_float(*(expr_type.arrow for expr_type in expr_types)))


def integer_result(low: int = INT64[0], high: int = INT64[1]) -> ExprType:
    """Return the type of an integer computed in 64 bits, with its possible range."""
    return ExprType(arrays.int64(), bounds=(max(low, INT64[0]), min(high, INT64[1])))


def _integers(expr_types: tuple[ExprType, ...]) -> bool:
    return all(expr_type.bounds is not None or pt.is_null(expr_type.arrow) for expr_type in expr_types)


def _interval(combine: Callable[[int, int], int]) -> Callable[[ExprType, ExprType], ExprType]:
    """Return the result type of an operator whose extremes result from the extremes of its operands."""

    def gives(left: ExprType, right: ExprType) -> ExprType:
        if not _integers((left, right)):
            return float_result(left, right)
        ends = [combine(a, b) for a in left.bounds or (0, 0) for b in right.bounds or (0, 0)]
        return integer_result(min(ends), max(ends))

    return gives


def _sum_type(left: ExprType, right: ExprType) -> ExprType:
    texts = [pt.is_string(expr_type.arrow) for expr_type in (left, right) if not pt.is_null(expr_type.arrow)]
    if texts and all(texts):
        return ExprType(arrays.string())
    for position, expr_type in enumerate((left, right)):
        if not (is_number(expr_type.arrow) or pt.is_null(expr_type.arrow)):
            hint = "convert the number with text(x)" if pt.is_string(expr_type.arrow) else None
            message = f"+ takes two numbers or two texts, not {format_type(left)} and {format_type(right)}"
            raise TypeMismatch(message, argument=position, hint=hint)
    return _interval(operator.add)(left, right)


def _ordered(left: ExprType, right: ExprType) -> ExprType:
    """Return the boolean type if two values can be compared."""
    for position, expr_type in enumerate((left, right)):
        if pt.is_null(expr_type.arrow):
            raise TypeMismatch(
                "a comparison with null is always null", argument=position, hint="use is_null(x)"
            )
    if not (is_number(left.arrow) and is_number(right.arrow)) and left.arrow != right.arrow:
        raise TypeMismatch(f"{format_type(left)} cannot be compared with {format_type(right)}")
    refuse_nested(left)
    return ExprType(arrays.bool_())


def refuse_nested(operand: ExprType) -> None:
    """Raise `TypeMismatch` for a list or message as the first of two compared operands."""
    if pt.is_nested(operand.arrow):
        message = f"{format_type(operand)} cannot be compared"
        raise TypeMismatch(message, argument=0, hint="compare its fields or elements")


def _to_int64(refuse: RejectRows, values: Array, nulls: Mask | None) -> Array:
    """Cast integers; refuse larger ones, unless they are in a row of `nulls`, whose result is null anyway."""
    if values.type != arrays.uint64():
        return values if values.type == arrays.int64() else pc.cast(values, arrays.int64())
    bad = true_mask(pc.greater(values, arrays.scalar(INT64[1], arrays.uint64())))
    if bad.any():
        refused = bad if nulls is None else bad & ~nulls
        if refused.any():
            refuse(refused, "overflow", lambda i: f"{values[i]} has more than 63 bits")
        values = set_null(values, bad)
    return pc.cast(values, arrays.int64())


def numbers(refuse: RejectRows, *values: Array) -> list[Array]:
    """Cast numbers to int64 if all are integers, else to float64."""
    if all(pt.is_integer(v.type) for v in values):
        masks = [mask for v in values if hasattr(v, "null_count") and (mask := null_mask(v)) is not None]
        nulls = np.logical_or.reduce(masks) if masks else None
        return [_to_int64(refuse, v, nulls) for v in values]
    return [v if pt.is_float64(v.type) else pc.cast(v, arrays.float64(), safe=False) for v in values]


def comparable(left: Array, right: Array) -> tuple[Array, Array]:
    """Cast two values to a type in which they can be compared without loss."""
    if left.type == right.type:
        return left, right
    if pt.is_floating(left.type) or pt.is_floating(right.type):
        both = arrays.float64()
    elif arrays.uint64() in {left.type, right.type}:
        both = arrays.decimal128(20)
    else:
        both = arrays.int64()
    return pc.cast(left, both, safe=False), pc.cast(right, both, safe=False)


def _length(left: Array, right: Array) -> int:
    return max(len(v) for v in (left, right) if hasattr(v, "__len__"))


def _as_list(values: Array, length: int) -> list[Any]:
    return values.to_pylist() if hasattr(values, "to_pylist") else [values.as_py()] * length


def _checked(
    refuse: RejectRows, sign: str, run: Callable[[Array, Array], Array], left: Array, right: Array
) -> Array:
    """Run a checked integer operation; if it overflows, find the rows one by one."""
    try:
        return run(left, right)
    except arrays.ArrowInvalid:
        pairs = list(zip(_as_list(left, n := _length(left, right)), _as_list(right, n), strict=True))
        bad = np.fromiter((_overflows(sign, a, b) for a, b in pairs), bool, n)
        refuse(bad, "overflow", lambda i: f"{pairs[i][0]} {sign} {pairs[i][1]} has more than 64 bits")
        return run(set_null(left, bad), set_null(right, bad))


_EXACT: dict[str, Callable[[int, int], int]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "**": operator.pow,
}


def _overflows(sign: str, left: int | None, right: int | None) -> bool:
    if left is None or right is None:
        return False
    if sign == "**" and right > _MOST_BITS:
        return abs(left) > 1
    return not INT64[0] <= _EXACT[sign](left, right) <= INT64[1]


def _arithmetic(sign: str, name: str, refuse: RejectRows, left: Array, right: Array) -> Array:
    left, right = numbers(refuse, left, right)
    if pt.is_integer(left.type):
        return _checked(refuse, sign, getattr(pc, f"{name}_checked"), left, right)
    return getattr(pc, name)(left, right)


@function(ANY, ANY, returns=_sum_type, name="+", scalars=True)
def add(refuse: RejectRows, left: Array, right: Array) -> Array:
    """Sum of two numbers, or two texts joined."""
    if pt.is_string(left.type) or pt.is_string(right.type):
        both = (pc.cast(left, arrays.string()), pc.cast(right, arrays.string()))
        return pc.binary_join_element_wise(*both, "")
    return _arithmetic("+", "add", refuse, left, right)


@function(NUMBER, NUMBER, returns=_interval(operator.sub), name="-", scalars=True)
def subtract(refuse: RejectRows, left: Array, right: Array) -> Array:
    """Difference."""
    return _arithmetic("-", "subtract", refuse, left, right)


@function(NUMBER, NUMBER, returns=_interval(operator.mul), name="*", scalars=True)
def multiply(refuse: RejectRows, left: Array, right: Array) -> Array:
    """Product."""
    return _arithmetic("*", "multiply", refuse, left, right)


@function(FLOAT, FLOAT, returns=float_result, name="/", scalars=True)
def divide(left: Array, right: Array) -> Array:
    """Quotient, always a float; division by zero gives inf or nan."""
    return pc.divide(left, right)


def _floored(refuse: RejectRows, sign: str, run: Any, left: Array, right: Array) -> Array:  # noqa: ANN401 - a numpy ufunc
    left, right = numbers(refuse, left, right)
    n = _length(left, right)
    if pt.is_integer(left.type):
        # null // 0 is null: only a division that takes place can be rejected.
        zero = np.broadcast_to(true_mask(pc.and_(pc.equal(right, 0), pc.is_valid(left))), n)
        lowest = pc.and_kleene(pc.equal(left, INT64[0]), pc.equal(right, -1))
        bad = zero | (np.broadcast_to(true_mask(lowest), n) & (sign == "//"))
        if bad.any():
            pairs = _as_list(left, n), _as_list(right, n)
            refuse(bad, "division", lambda i: f"{pairs[0][i]} {sign} {pairs[1][i]} has no result")
            right = set_null(right, bad)
    absent = np.broadcast_to(np.asarray(pc.or_(pc.is_null(left), pc.is_null(right))), n)
    with np.errstate(all="ignore"):
        values = run(np.asarray(pc.fill_null(left, 1)), np.asarray(pc.fill_null(right, 1)))
    return arrays.array(np.broadcast_to(values, n), mask=absent if absent.any() else None)


def _remainder_type(left: ExprType, right: ExprType) -> ExprType:
    if not _integers((left, right)):
        return float_result(left, right)
    low, high = right.bounds or (0, 0)
    return integer_result(min(low + 1, 0), max(high - 1, 0))


def _floor_type(left: ExprType, right: ExprType) -> ExprType:
    if not _integers((left, right)):
        return float_result(left, right)
    reach = max(abs(end) for end in left.bounds or (0, 0))
    positive = min(*(left.bounds or (0, 0)), *(right.bounds or (0, 0))) >= 0
    return integer_result(0 if positive else -reach, reach)


@function(NUMBER, NUMBER, returns=_floor_type, name="//")
def floor_divide(refuse: RejectRows, left: Array, right: Array) -> Array:
    """Quotient rounded down."""
    return _floored(refuse, "//", np.floor_divide, left, right)


@function(NUMBER, NUMBER, returns=_remainder_type, name="%")
def remainder(refuse: RejectRows, left: Array, right: Array) -> Array:
    """Remainder, with the sign of the divisor."""
    return _floored(refuse, "%", np.mod, left, right)


def _power_type(left: ExprType, right: ExprType) -> ExprType:
    natural = right.bounds is not None and right.bounds[0] >= 0
    return integer_result() if _integers((left, right)) and natural else float_result(left, right)


@function(NUMBER, NUMBER, returns=_power_type, name="**", scalars=True)
def power(refuse: RejectRows, left: Array, right: Array) -> Array:
    """Power; an integer if both operands are integers and the exponent cannot be negative."""
    natural = pt.is_unsigned_integer(right.type) or (
        isinstance(right, arrays.Int64Scalar) and right.is_valid and right.as_py() >= 0
    )
    left, right = numbers(refuse, left, right)
    if natural and pt.is_integer(left.type):
        return _checked(refuse, "**", pc.power_checked, left, right)
    return pc.power(pc.cast(left, arrays.float64(), safe=False), pc.cast(right, arrays.float64(), safe=False))


def _negative_type(of: ExprType) -> ExprType:
    return integer_result(-of.bounds[1], -of.bounds[0]) if of.bounds is not None else float_result(of)


@function(NUMBER, returns=_negative_type)
def negative(refuse: RejectRows, x: Array) -> Array:
    """Negation."""
    (x,) = numbers(refuse, x)
    zero = arrays.scalar(0, x.type)
    return _checked(refuse, "-", pc.subtract_checked, zero, x) if pt.is_integer(x.type) else pc.negate(x)


def _same_type(expr_type: ExprType) -> ExprType:
    return expr_type


@function(NUMBER, returns=_same_type)
def positive(x: Array) -> Array:
    """The operand, unchanged."""
    return x


def _add_comparison(sign: str, run: Callable[[Any, Any], Any]) -> None:
    def compare(left: Array, right: Array) -> Array:
        """Comparison."""
        return run(*comparable(left, right))

    function(ANY, ANY, returns=_ordered, name=sign, scalars=True, sees_null=True)(compare)


for _sign, _run in (
    ("==", pc.equal),
    ("!=", pc.not_equal),
    ("<", pc.less),
    ("<=", pc.less_equal),
    (">", pc.greater),
    (">=", pc.greater_equal),
):
    _add_comparison(_sign, _run)


@function(BOOLEAN, BOOLEAN, returns=arrays.bool_(), name="and", sees_null=True)
def and_(left: Array, right: Array) -> Array:
    """Whether both are true, with three-valued logic for null."""
    return pc.and_kleene(left, right)


@function(BOOLEAN, BOOLEAN, returns=arrays.bool_(), name="or", sees_null=True)
def or_(left: Array, right: Array) -> Array:
    """Whether at least one is true, with three-valued logic for null."""
    return pc.or_kleene(left, right)


@function(BOOLEAN, returns=arrays.bool_(), name="not")
def not_(x: Array) -> Array:
    """Logical negation."""
    return pc.invert(x)


def _bits(expr_type: ExprType) -> tuple[int, int]:
    return expr_type.bounds or (0, 0)


def _and_type(left: ExprType, right: ExprType) -> ExprType:
    natural = [high for low, high in (_bits(left), _bits(right)) if low >= 0]
    return integer_result(0, min(natural)) if natural else integer_result()


def _or_type(left: ExprType, right: ExprType) -> ExprType:
    bounds = (_bits(left), _bits(right))
    if min(low for low, _ in bounds) < 0:
        return integer_result()
    return integer_result(0, 2 ** max(high for _, high in bounds).bit_length() - 1)


def _inverted_type(x: ExprType) -> ExprType:
    low, high = _bits(x)
    return integer_result(-high - 1, -low - 1)


def _left_shift_type(_: ExprType, _n: ExprType) -> ExprType:
    return integer_result()


def _right_shift_type(x: ExprType, _: ExprType) -> ExprType:
    low, high = _bits(x)
    return integer_result(min(low, 0), max(high, 0))


def _bits_of(word: str) -> Parameter:
    return replace(INTEGER, hint=f"write `{word}` for conditions, cast(x, 'int64') for a number")


def _add_bit_operator(sign: str, word: str, run: Callable[[Array, Array], Array], returns: Any) -> None:  # noqa: ANN401 - a result type
    def apply(refuse: RejectRows, left: Array, right: Array) -> Array:
        """Bitwise operation on integers of up to 63 bits and a sign."""
        return run(*numbers(refuse, left, right))

    operand = _bits_of(word)
    function(operand, operand, returns=returns, name=sign, scalars=True)(apply)


for _sign, _word, _run, _returns in (
    ("&", "and", pc.bit_wise_and, _and_type),
    ("|", "or", pc.bit_wise_or, _or_type),
    ("^", "!=", pc.bit_wise_xor, _or_type),
):
    _add_bit_operator(_sign, _word, _run, _returns)


@function(_bits_of("not"), returns=_inverted_type, name="~")
def invert(refuse: RejectRows, x: Array) -> Array:
    """Bitwise negation."""
    return pc.bit_wise_not(*numbers(refuse, x))


def shifted(refuse: RejectRows, sign: str, x: Array, n: Array) -> Array:
    """Shift integers by a number of bits from 0 to 63; reject rows with another number, or with an overflow."""
    x, n = numbers(refuse, x, n)
    wrong = true_mask(pc.and_(pc.is_valid(x), pc.or_(pc.less(n, 0), pc.greater(n, _MOST_BITS - 1))))
    if wrong.any():
        refuse(wrong, "overflow", lambda i: f"{n[i]} is not a number of bits from 0 to {_MOST_BITS - 1}")
        n = set_null(n, wrong)
    if sign == ">>":
        return _in_two_steps(pc.shift_right, x, n)
    result = _in_two_steps(pc.shift_left, x, n)
    overflow = true_mask(pc.not_equal(_in_two_steps(pc.shift_right, result, n), x))
    if overflow.any():
        refuse(overflow, "overflow", lambda i: f"{x[i]} << {n[i]} has more than 64 bits")
    return result


def _in_two_steps(shift: Callable[[Array, Array], Array], x: Array, n: Array) -> Array:
    """Shift by `n` bits in two steps, because Arrow returns signed integers unchanged for 63 bits."""
    half = pc.shift_right(n, 1)
    return shift(shift(x, half), pc.subtract(n, half))


@function(INTEGER, INTEGER, returns=_left_shift_type, name="<<")
def left_shift(refuse: RejectRows, x: Array, n: Array) -> Array:
    """Integer shifted to higher bits."""
    return shifted(refuse, "<<", x, n)


@function(INTEGER, INTEGER, returns=_right_shift_type, name=">>")
def right_shift(refuse: RejectRows, x: Array, n: Array) -> Array:
    """Integer shifted to lower bits; the sign is kept."""
    return shifted(refuse, ">>", x, n)
