"""Evaluation by columns compared with a plain Python interpreter of single messages."""

from __future__ import annotations

import contextlib
import math
import operator
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
from every_kind import every_kind
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.mapping.checker import Checker, Scope
from mosaico_ingest.adapters.mapping.columns import ExprType
from mosaico_ingest.adapters.mapping.evaluator import Evaluation, RowsRejected
from mosaico_ingest.adapters.mapping.expressions import (
    Cast,
    CloseList,
    Conditional,
    Constant,
    ElementAt,
    FieldAccess,
    FunctionCall,
    MakeList,
    MessageRef,
    OpenList,
    TypedExpression,
    parse,
)

MESSAGE = every_kind()


class RefusedError(Exception):
    """Raised if a row is rejected."""


# --- the slow twin -------------------------------------------------------------------------------------------------


def interpret(typed: TypedExpression, row: dict[str, Any]) -> Any:  # noqa: PLR0911 - a return for each kind of node
    """Return the value for one message; variable-size lists are Python lists."""
    match typed:
        case MessageRef():
            return row
        case Constant():
            return typed.value
        case FieldAccess():
            return each(
                lambda of: None if of is None else of[typed.name],
                interpret(typed.operand, row),
                depth(typed.operand),
            )
        case OpenList() | CloseList():
            return interpret(typed.operand, row)
        case ElementAt():
            return each(lambda of: item(of, typed.index), interpret(typed.operand, row), depth(typed.operand))
        case Cast():
            return each(
                lambda of: cast(of, typed.target), interpret(typed.operand, row), depth(typed.operand)
            )
        case MakeList():
            return spread(lambda *items: list(items), typed.items, row)
        case Conditional():
            return choose(typed, row)
        case FunctionCall():
            whole = all(a.type.bounds is not None for a in typed.arguments)
            numeric = COMPUTED.get(typed.name)
            return spread(
                partial(numeric, whole=whole) if numeric else PLAIN[typed.name], typed.arguments, row
            )


def depth(typed: TypedExpression) -> int:
    return len(typed.type.axes)


def each(run: Callable[[Any], Any], value: Any, levels: int) -> Any:
    if levels == 0 or value is None:
        return run(value) if levels == 0 else None
    return [each(run, element, levels - 1) for element in value]


def spread(run: Callable[..., Any], arguments: tuple[TypedExpression, ...], row: dict[str, Any]) -> Any:
    return broadcast(run, [interpret(a, row) for a in arguments], [depth(a) for a in arguments])


def broadcast(run: Callable[..., Any], values: list[Any], depths: list[int]) -> Any:
    lengths = {len(value) for value, levels in zip(values, depths, strict=True) if levels}
    if not lengths:
        return run(*values)
    if len(lengths) > 1:
        raise RefusedError
    return [
        broadcast(
            run,
            [v[k] if levels else v for v, levels in zip(values, depths, strict=True)],
            [max(levels - 1, 0) for levels in depths],
        )
        for k in range(lengths.pop())
    ]


def choose(typed: Conditional, row: dict[str, Any]) -> Any:
    condition = interpret(typed.condition, row)
    if depth(typed.condition) == 0 and depth(typed) == 0:
        return None if condition is None else interpret(typed.then if condition else typed.otherwise, row)
    parts = (typed.condition, typed.then, typed.otherwise)
    values = [interpret(part, row) for part in parts]  # the generator puts nothing that refuses in here
    pick = lambda c, a, b: None if c is None else a if c else b  # noqa: E731 - shorter than its name
    return broadcast(pick, values, [depth(part) for part in parts])


def item(values: list[Any] | None, index: int) -> Any:
    if values is None or not -len(values) <= index < len(values):
        return None
    return values[index]


def cast(value: Any, type_: pa.DataType) -> Any:
    if value is None:
        return None
    if pa.types.is_boolean(type_):
        if value not in {0, 1}:
            raise RefusedError
        return bool(value)
    if pa.types.is_integer(type_):
        low, high = np.iinfo(str(type_)).min, np.iinfo(str(type_)).max
        if not math.isfinite(value) or value != math.trunc(value) or not low <= value <= high:
            raise RefusedError
        return int(value)
    if type_ == pa.float32():
        with np.errstate(over="ignore"):
            narrow = float(np.float32(value))
        if math.isinf(narrow) and not math.isinf(value):
            raise RefusedError
        return narrow
    return float(value)


def strict(run: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *a, **how: None if any(v is None for v in a) else run(*a, **how)


def arithmetic(run: Callable[[Any, Any], Any]) -> Callable[..., Any]:
    def compute(a: Any, b: Any, *, whole: bool) -> Any:
        if isinstance(a, str):
            return a + b
        return bounded(run(bounded(a), bounded(b))) if whole else ieee(run, float(a), float(b))

    return strict(compute)


def bounded(value: int) -> int:
    if not -(2**63) <= value < 2**63:
        raise RefusedError
    return value


def ieee(run: Callable[[Any, Any], Any], a: float, b: float) -> float:
    with np.errstate(all="ignore"):
        return float(run(np.float64(a), np.float64(b)))


def floored(run: Callable[[Any, Any], Any]) -> Callable[..., Any]:
    def compute(a: Any, b: Any, *, whole: bool) -> Any:
        if whole:
            if b == 0:
                raise RefusedError
            return bounded(run(bounded(a), bounded(b)))
        return ieee(run, float(a), float(b))

    return strict(compute)


def compared(run: Callable[[Any, Any], bool]) -> Callable[..., Any]:
    def compare(a: Any, b: Any) -> bool:
        if isinstance(a, float) or isinstance(b, float):
            a, b = float(a), float(b)
        return run(a, b)

    return strict(compare)


def both(a: Any, b: Any) -> Any:
    if a is False or b is False:
        return False
    return None if a is None or b is None else True


def one(a: Any, b: Any) -> Any:
    if a is True or b is True:
        return True
    return None if a is None or b is None else False


def extreme(pick: Callable[..., Any]) -> Callable[..., Any]:
    def run(*values: Any, whole: bool) -> Any:
        if whole:
            return pick(bounded(v) for v in values)
        numbers = [float(v) for v in values]
        known = [v for v in numbers if not math.isnan(v)]
        return pick(known) if known else math.nan

    return strict(run)


def folded(run: Callable[[list[Any]], Any], empty: Any) -> Callable[..., Any]:
    def fold(values: Any) -> Any:
        if any(v is None for v in values):
            return None
        return run(values) if values else empty

    return strict(fold)


def power(a: Any, b: Any, *, whole: bool) -> Any:
    if whole and b >= 0:
        return bounded(bounded(a) ** bounded(b))
    return ieee(np.power, float(a), float(b))


def negative(a: Any, *, whole: bool) -> Any:
    return bounded(-bounded(a)) if whole else -float(a)


COMPUTED: dict[str, Callable[..., Any]] = {
    "+": arithmetic(operator.add),
    "-": arithmetic(operator.sub),
    "*": arithmetic(operator.mul),
    "//": floored(lambda a, b: np.floor_divide(a, b) if isinstance(a, np.floating) else a // b),
    "%": floored(lambda a, b: np.mod(a, b) if isinstance(a, np.floating) else a % b),
    "**": strict(power),
    "negative": strict(negative),
    "min": extreme(min),
    "max": extreme(max),
}
"""The operations that differ for integers and floats."""
PLAIN: dict[str, Callable[..., Any]] = {
    "/": strict(lambda a, b: ieee(operator.truediv, float(a), float(b))),
    "==": compared(operator.eq),
    "!=": compared(operator.ne),
    "<": compared(operator.lt),
    "<=": compared(operator.le),
    ">": compared(operator.gt),
    ">=": compared(operator.ge),
    "and": both,
    "or": one,
    "not": strict(operator.not_),
    "is_null": lambda a: a is None,
    "coalesce": lambda *a: next((v for v in a if v is not None), None),
    "nan_to_null": strict(lambda a: None if math.isnan(a) else a),
    "empty_to_null": strict(lambda a: a or None),
    "len": strict(len),
    "sum": folded(lambda v: bounded(sum(v)) if isinstance(v[0], int) else math.fsum(v), 0),
    "mean": folded(lambda v: math.fsum(v) / len(v), None),
    "any": folded(any, empty=False),
    "all": folded(all, empty=True),
    "lower": strict(str.lower),
    "covariance": strict(lambda a: a if any(v is not None and v > 0 for v in a) else None),
    "variance": strict(lambda a: a if a > 0 else None),
}


# --- generators ---------------------------------------------------------------------------------------------

FLOATS = st.floats(width=32) | st.sampled_from([0.0, -1.0, 1.0, 0.5, math.inf, math.nan])
DOUBLES = st.floats(-1e6, 1e6) | st.sampled_from([0.0, math.inf, -math.inf, math.nan])
TEXTS = st.sampled_from(["", "a", "Ab", "żó", "42"])


def integers(low: int, high: int) -> st.SearchStrategy[int]:
    return st.integers(max(low, -5), min(high, 5)) | st.sampled_from([low, high])


def inner() -> st.SearchStrategy[dict[str, Any]]:
    numbers = st.lists(st.sampled_from([0.0, 1.5, -2.0]), max_size=3)
    return st.fixed_dictionaries({"v": integers(-(2**15), 2**15 - 1), "t": TEXTS, "n": numbers})


ROWS = st.lists(
    st.fixed_dictionaries(
        {
            "b": st.booleans(),
            "i": integers(-128, 127),
            "u": integers(0, 255),
            "k": integers(-(2**63), 2**63 - 1),
            "w": integers(0, 2**64 - 1),
            "f": FLOATS,
            "d": DOUBLES,
            "s": TEXTS,
            "x": st.lists(integers(-(2**31), 2**31 - 1), max_size=3),
            "y": st.lists(st.sampled_from([-1.0, 0.0, 2.5]), min_size=3, max_size=3),
            "m": st.lists(inner(), max_size=3),
            "p": inner(),
        }
    ),
    max_size=6,
)

NUMBERS = st.sampled_from(
    [
        "i",
        "u",
        "k",
        "w",
        "f",
        "d",
        "p.v",
        "x[0]",
        "y[-1]",
        "m[0].v",
        "len(s)",
        "len(m)",
        "1",
        "0",
        "2",
        "0.5",
        "-3",
        "null",
    ]
)
PER_ELEMENT = st.sampled_from(["m[].v", "x[]", "y[]", "len(m[].t)", "m[].n[]", "m[].n[0]"])


def grown(inner_: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    sign = st.sampled_from(["+", "-", "*", "/", "//", "%"])
    compare = st.sampled_from(["==", "!=", "<", "<=", ">", ">="])
    condition = st.builds(lambda a, c, b: f"({a} {c} {b})", inner_, compare, inner_)
    conditions = condition | st.builds(
        lambda a, j, b: f"({a} {j} {b})", condition, st.sampled_from(["and", "or"]), condition | st.just("b")
    )
    return st.one_of(
        st.builds(lambda a, s, b: f"({a} {s} {b})", inner_, sign, inner_),
        st.builds(lambda a, b: f"({a} ** {b})", inner_, st.sampled_from(["2", "0", "3", "0.5", "u"])),
        st.builds(lambda a: f"(-{a})", inner_),
        st.builds(lambda a, b: f"coalesce({a}, {b})", inner_, inner_),
        st.builds(lambda f, a: f"{f}({a})", st.sampled_from(["nan_to_null", "variance"]), inner_),
        st.builds(lambda f, a, b: f"{f}({a}, {b})", st.sampled_from(["min", "max"]), inner_, inner_),
        st.builds(
            lambda a, t: f"cast({a}, '{t}')", inner_, st.sampled_from(["int8", "uint16", "float32", "int64"])
        ),
        st.builds(lambda c, a, b: f"({a} if {c} else {b})", conditions, inner_, inner_),
        st.builds(lambda c, a: f"(0 if is_null({c}) else {a})", inner_, inner_),
    )


def reduced(inner_: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    return st.one_of(
        grown(inner_),
        st.builds(lambda f, a: f"{f}({a})", st.sampled_from(["sum", "mean", "covariance"]), PER_ELEMENT),
        st.builds(
            lambda f, a, b: f"(1 if {f}({a} > {b}) else 0)",
            st.sampled_from(["any", "all"]),
            PER_ELEMENT,
            NUMBERS,
        ),
    )


SCALARS = st.recursive(NUMBERS, reduced, max_leaves=6)
LISTS = st.recursive(
    PER_ELEMENT | NUMBERS,
    lambda i: st.builds(lambda a, s, b: f"({a} {s} {b})", i, st.sampled_from(["+", "-", "*"]), i),
    max_leaves=4,
)
OTHERS = st.sampled_from(
    ["s + '-' + p.t", "lower(m[].t)", "empty_to_null(s)", "empty_to_null(x)", "covariance(y)", "[i, u, 1]", "[x[], 1]", "s == 'a'"]
)  # fmt: skip


def typed_of(text: str) -> TypedExpression | None:
    scope = Scope(ExprType(MESSAGE), {})
    return Checker(scope, lambda *_: None, text).infer(parse(text))


def over_columns(typed: TypedExpression, rows: list[dict[str, Any]]) -> dict[int, Any]:
    """Return the value of every row that is not rejected."""
    array, index = pa.array(rows, MESSAGE), np.arange(len(rows))
    while True:
        envelope = Envelope("", "", np.zeros(len(array), np.int64))
        try:
            column = Evaluation(array, envelope).evaluate(typed)
        except RowsRejected as rejected:
            good = np.ones(len(array), bool)
            good[list(rejected.rejections)] = False
            array, index = array.filter(pa.array(good)), index[good]
            continue
        values = column.close_all(len(array))
        values.validate(full=True)
        return dict(zip(index.tolist(), values.to_pylist(), strict=True))


def over_rows(typed: TypedExpression, rows: list[dict[str, Any]]) -> dict[int, Any]:
    values: dict[int, Any] = {}
    for position, row in enumerate(pa.array(rows, MESSAGE).to_pylist()):
        with contextlib.suppress(RefusedError):
            values[position] = interpret(typed, row)
    return values


def same(left: Any, right: Any) -> bool:
    if isinstance(left, list) and isinstance(right, list):
        return len(left) == len(right) and all(map(same, left, right))
    if isinstance(left, float) and isinstance(right, float | int):
        if math.isnan(left) or math.isnan(right):
            return math.isnan(left) and math.isnan(right)
        return left == right or math.isclose(left, right, rel_tol=1e-9, abs_tol=1e-12)
    return left == right


@settings(max_examples=80, deadline=None)
@given(text=SCALARS | LISTS | OTHERS, rows=ROWS)
def test_evaluation_of_columns_equals_interpreter(text: str, rows: list[dict[str, Any]]) -> None:
    typed = typed_of(text)
    assume(typed is not None)
    assert typed is not None
    fast, slow = over_columns(typed, rows), over_rows(typed, rows)
    assert fast.keys() == slow.keys(), text
    assert all(same(fast[row], slow[row]) for row in slow), (text, fast, slow)


@settings(max_examples=25, deadline=None)
@given(text=SCALARS | LISTS | OTHERS, rows=ROWS)
def test_evaluation_of_single_rows_equals_batch(text: str, rows: list[dict[str, Any]]) -> None:
    typed = typed_of(text)
    assume(typed is not None)
    assert typed is not None
    together = over_columns(typed, rows)
    alone = {i: value for i, row in enumerate(rows) for value in over_columns(typed, [row]).values()}
    assert together.keys() == alone.keys()
    assert all(same(together[row], alone[row]) for row in together)


@settings(max_examples=30, deadline=None)
@given(text=SCALARS, rows=ROWS)
def test_evaluation_integers_stay_within_inferred_bounds(text: str, rows: list[dict[str, Any]]) -> None:
    typed = typed_of(text)
    assume(typed is not None)
    assert typed is not None
    bounds = typed.type.bounds
    assume(bounds is not None and not typed.type.axes)
    assert bounds is not None
    for value in over_columns(typed, rows).values():
        assert value is None or bounds[0] <= value <= bounds[1], text
