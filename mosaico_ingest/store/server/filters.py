"""This file is the conditions of a query, `{operator: value}`, each asked of a value, of a span, or of a column."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping
from fnmatch import translate
from functools import reduce
from typing import Any, Final, Protocol

import pyarrow as pa
import pyarrow.compute as pc

from mosaico_ingest.frozen import frozen
from mosaico_ingest.store.server.refusals import Refusal
from mosaico_ingest.wire.conditions import Condition

__all__ = ["MISSING", "Comparison", "Test", "tests_of"]

MISSING: Final = object()
"""Where there is no value to ask."""


class Test(Protocol):
    """One condition."""

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - anything that JSON holds, or MISSING
        """Return whether a single value passes."""
        ...

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401 - numbers or text
        """Return whether a value from `low` to `high` may pass."""
        ...

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:
        """Return the same for a column of that type."""
        ...


_HUGE = 2**1023
"""Whole numbers up to here are some float."""
_GLOB_WORDS = re.compile(r"\[!?\]?[^]]*\]|.", re.DOTALL)
"""A choice in brackets, or one character."""
_COMPARISONS: Mapping[str, Callable[[Any, Any], Any]] = {
    "$eq": operator.eq,
    "$neq": operator.ne,
    "$lt": operator.lt,
    "$leq": operator.le,
    "$gt": operator.gt,
    "$geq": operator.ge,
}


@frozen
class Comparison:
    """`$eq $neq $lt $leq $gt $geq`: how a value stands to another."""

    operator: str
    bound: str | float

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the value stands so; values of another kind do not."""
        return _alike(value, self.bound) and bool(_COMPARISONS[self.operator](value, self.bound))

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether one end of the span stands so, or the bound lies inside."""
        if self.operator == "$neq" or not _alike(low, self.bound):
            return True
        if self.operator == "$eq":
            return low <= self.bound <= high
        return bool(
            _COMPARISONS[self.operator](low if self.operator in {"$lt", "$leq"} else high, self.bound)
        )

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:
        """Return the comparison."""
        return _compared(self.operator, column, self.bound, kind)


@frozen
class Outside:
    """`$outside [low, high]`: below or above."""

    low: float
    high: float

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the value is a number outside."""
        return _alike(value, self.low) and bool(value < self.low or value > self.high)

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the span reaches outside."""
        return not _alike(low, self.low) or bool(low < self.low or high > self.high)

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:
        """Return both comparisons."""
        return _compared("$lt", column, self.low, kind) | _compared("$gt", column, self.high, kind)


@frozen
class Choice:
    """`$in [a, b, …]`: one of them."""

    choices: tuple[str | float, ...]

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the value is one of them."""
        return any(_alike(value, choice) and value == choice for choice in self.choices)

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether one of them lies inside."""
        return any(not _alike(low, choice) or low <= choice <= high for choice in self.choices)

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:
        """Return the membership."""
        equal = (_compared("$eq", column, choice, kind) for choice in self.choices)
        return reduce(operator.or_, equal)


@frozen
class Glob:
    """`$match pattern`: a whole text, with `*`, `?`, `[…]`, and `#` for a digit."""

    pattern: str

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the value is a text of that form."""
        return isinstance(value, str) and re.fullmatch(self._expression(), value) is not None

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401, ARG002 - see Test
        """Return that it may."""
        return True

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:  # noqa: ARG002 - text only
        """Return the match."""
        return pc.match_substring_regex(column, f"^{self._expression()}$")

    def _expression(self) -> str:
        """Return the pattern in words that Python and Arrow share: fnmatch alone looks ahead where there are several `*`."""
        return f"(?s:{''.join(map(_spelled, _GLOB_WORDS.findall(self.pattern)))})"


@frozen
class Presence:
    """`$ex`, `$nex`: whether there is a value."""

    wanted: bool

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the value is there, or is not, as wanted."""
        return (value is not MISSING and value is not None) is self.wanted

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401, ARG002 - see Test
        """Return that it may."""
        return True

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:  # noqa: ARG002 - any type
        """Return the validity."""
        absent = column.is_null()
        return ~absent if self.wanted else absent


def _spelled(word: str) -> str:
    """Return one word of a glob as a regular expression."""
    if word == "*":
        return ".*"
    expression = translate("[0-9]" if word == "#" else word.replace("#", "0-9"))
    return expression[len("(?s:") : -len(r")\Z")].replace("(?!)", r"[^\s\S]")  # nothing, as of [z-a]


def tests_of(conditions: object, *, of: str) -> list[Test]:
    """Return the tests in `{operator: value, …}`, or refuse what is no such thing."""
    if not isinstance(conditions, Mapping):
        raise Refusal(Condition.INVALID, f"{of}: {conditions!r} is not {{operator: value}}")
    return [test for name, operand in conditions.items() for test in _tests(str(name), operand, of)]


def _compared(name: str, column: pc.Expression, bound: str | float, kind: pa.DataType) -> pc.Expression:
    """Return a comparison; whole numbers are compared as such, since Arrow refuses those no float can hold."""
    if pa.types.is_integer(kind) and not isinstance(bound, str | bool):
        return _compared_whole(name, column, bound, kind)
    if isinstance(bound, int) and not isinstance(bound, bool):
        bound = float(bound) if abs(bound) < _HUGE else math.copysign(math.inf, bound)
    compared: pc.Expression = _COMPARISONS[name](column, bound)
    return compared


def _compared_whole(name: str, column: pc.Expression, bound: float, kind: pa.DataType) -> pc.Expression:
    signed = pa.types.is_signed_integer(kind)
    high = 2 ** (kind.bit_width - signed) - 1
    low = -high - 1 if signed else 0

    def above(limit: int) -> pc.Expression:
        if limit < low:
            return column >= pa.scalar(low, kind)
        return column > pa.scalar(min(limit, high), kind)

    if math.isnan(bound):
        return ~above(high) if name == "$neq" else above(high)
    near = max(low - 1, min(bound, high + 1))
    at, below = math.floor(near), math.ceil(near) - 1
    match name:
        case "$gt" | "$leq":
            return above(at) if name == "$gt" else ~above(at)
        case "$geq" | "$lt":
            return above(below) if name == "$geq" else ~above(below)
        case _:
            equal = above(below) & ~above(at)
            return equal if name == "$eq" else ~equal


def _tests(name: str, operand: object, of: str) -> list[Test]:
    match name, operand:
        case "$between", [str() | int() | float() as low, str() | int() | float() as high]:
            return [Comparison("$geq", low), Comparison("$leq", high)]
        case "$outside", [int() | float() as low, int() | float() as high]:
            return [Outside(low, high)]
        case "$in", [*choices] if choices and all(isinstance(each, str | int | float) for each in choices):
            return [Choice(tuple(choices))]
        case "$match", str() as pattern:
            return [Glob(pattern)]
        case (("$ex" | "$nex"), _):
            return [Presence(name == "$ex")]
        case _, (str() | int() | float()) as bound if name in _COMPARISONS:
            return [Comparison(name, bound)]
        case _:
            known = ", ".join([*_COMPARISONS, "$between", "$outside", "$in", "$match", "$ex", "$nex"])
            raise Refusal(Condition.INVALID, f"{of}: {name} {operand!r} is no condition; there are {known}")


def _alike(value: object, bound: object) -> bool:
    """Return whether two values can be compared: both text, or both numbers."""
    if isinstance(value, str) or isinstance(bound, str):
        return isinstance(value, str) and isinstance(bound, str)
    return isinstance(value, int | float)
