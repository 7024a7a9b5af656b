"""This file is the conditions of a query, `{operator: value}`, each asked of a value, of a span, or of a column."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping
from fnmatch import translate
from typing import Any, Final, Protocol, cast

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

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:  # noqa: ARG002 - Arrow promotes
        """Return the comparison."""
        compared: pc.Expression = _COMPARISONS[self.operator](column, self.bound)
        return compared


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

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:  # noqa: ARG002 - Arrow promotes
        """Return both comparisons."""
        return (column < pc.scalar(self.low)) | (column > pc.scalar(self.high))


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
        return column.isin(pa.array(list[Any](self.choices)).cast(kind))


_GLOB_PART = re.compile(r"(?P<stars>\*+)|\[!?\]?[^\]]*\]|.", re.DOTALL)
"""Stars, a set, or a character; `translate` writes each but the stars as `(?s:…)\\Z`."""


@frozen
class Glob:
    """`$match pattern`: a whole text, with `*`, `?`, `[…]`, and `#` for a digit."""

    pattern: str

    def holds(self, value: Any) -> bool:  # noqa: ANN401 - see Test
        """Return whether the value is a text of that form."""
        return isinstance(value, str) and re.match(translate(self._glob), value) is not None

    def may_hold(self, low: Any, high: Any) -> bool:  # noqa: ANN401, ARG002 - see Test
        """Return that it may."""
        return True

    def column(self, column: pc.Expression, kind: pa.DataType) -> pc.Expression:  # noqa: ARG002 - text only
        """Return the match in the dialect of RE2, which lacks what `translate` makes of several stars."""
        parts = (
            ".*" if part["stars"] else translate(part[0])[4:-3] for part in _GLOB_PART.finditer(self._glob)
        )
        return pc.match_substring_regex(column, f"^(?s:{''.join(parts)})$")

    @property
    def _glob(self) -> str:
        return self.pattern.replace("#", "[0-9]")


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


def tests_of(conditions: object, *, of: str) -> list[Test]:
    """Return the tests in `{operator: value, …}`, or refuse what is no such thing."""
    if not isinstance(conditions, Mapping):
        raise Refusal(Condition.INVALID, f"{of}: {conditions!r} is not {{operator: value}}")
    return [
        test for name, operand in conditions.items() for test in _tests(str(name), _storable(operand), of)
    ]


def _storable(operand: object) -> object:
    """Return an operand whose numbers Arrow can hold: whole ones beyond 64 bits as the nearest float."""
    if isinstance(operand, list):
        return [_storable(each) for each in cast("list[object]", operand)]  # JSON has no other lists
    if isinstance(operand, int) and not -(2**63) <= operand < 2**63:
        return float(operand) if abs(operand) < _HUGE else math.copysign(math.inf, operand)
    return operand


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
