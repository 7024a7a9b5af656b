"""This file computes typed expressions over all rows of a batch at once."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import TypeAlias

import numpy as np
import pyarrow as pa

from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.mapping.columns import (
    Array,
    Axis,
    Column,
    Mask,
    arrays,
    field_of,
    fixed_list,
    open_list,
    pc,
    promote,
    pt,
    repeat,
    true_mask,
)
from mosaico_ingest.adapters.mapping.conversion import to_number
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
)
from mosaico_ingest.adapters.mapping.functions.registry import RejectRows

__all__ = ["Evaluation", "Rejection", "RowsRejected"]


Rejection: TypeAlias = tuple[str, str]
"""The rule a row broke, and why."""


class RowsRejected(Exception):  # noqa: N818 - a signal: go on without these rows
    """Rows that do not fit; the caller evaluates the others again, without them."""

    def __init__(self, refusals: dict[int, Rejection]) -> None:
        super().__init__(f"{len(refusals)} rows")
        self.refusals = refusals


class Evaluation:
    """The values of expressions over one batch; each is computed once."""

    def __init__(self, rows: Array, envelope: Envelope) -> None:
        self.rows = rows
        self.envelope = envelope
        self.target = ""
        """The field being filled, for messages."""
        self._cache: dict[TypedExpression, Column] = {}
        self._branch_conditions: list[Column] = []
        """Conditions of the branches being evaluated: only rows where all hold count."""

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.rows)

    def evaluate(self, typed: TypedExpression) -> Column:
        """Return the values of an expression.

        Raises:
            RowsRefused: Some rows do not fit it.
        """
        known = self._cache.get(typed)
        if known is None:
            known = self._compute(typed)
            if (
                not self._branch_conditions
            ):  # inside a branch, values of the rows that do not take it may be missing
                self._cache[typed] = known
        return known

    def mask(self, typed: TypedExpression) -> Mask:
        """Return where a condition without open lists holds."""
        values = self.evaluate(typed).array(len(self))
        return true_mask(pc.cast(values, arrays.bool_()))

    @contextmanager
    def within(self, condition: Column) -> Generator[None]:
        """Let only rows that take a branch reject themselves."""
        self._branch_conditions.append(condition)
        try:
            yield
        finally:
            self._branch_conditions.pop()

    def rejecter(self, axes: tuple[Axis, ...], text: str | None) -> RejectRows:
        """Return a way to reject the rows that elements belong to; without `text`, reasons stand as they are."""
        target = self.target

        def refuse(bad: Mask, rule: str, says: Callable[[int], str]) -> None:
            count = len(axes[-1].parents) if axes else len(self)
            single = len(bad) != count
            live = self._live(np.broadcast_to(bad, count), axes)
            if not live.any():
                return
            what = "" if text is None else f"{target}: " if text == target else f"{target}: `{text}`: "
            refusals: dict[int, Rejection] = {}
            positions = np.flatnonzero(live)
            rows = positions
            for axis in reversed(axes):
                rows = axis.parents[rows]
            for row, position in zip(rows.tolist(), positions.tolist(), strict=True):
                if row not in refusals:
                    refusals[row] = (rule, what + says(0 if single else position))
            raise RowsRejected(refusals)

        return refuse

    def _live(self, bad: Mask, axes: tuple[Axis, ...]) -> Mask:
        for condition in self._branch_conditions:
            if len(condition.axes) <= len(axes) and all(map(Axis.matches, condition.axes, axes)):
                values = condition.broadcast_to(axes).array(len(bad))
                bad = bad & true_mask(values)
        return bad

    def _compute(self, typed: TypedExpression) -> Column:
        match typed:
            case MessageRef():
                return Column(self.rows)
            case Constant():
                return Column(_scalar(typed))
            case FunctionCall():
                return self._apply(typed)
            case MakeList():
                return self._list(typed)
            case Conditional():
                return self._choice(typed)
            case _:
                return self._derived(typed, self.evaluate(typed.operand))

    def _derived(self, typed: FieldAccess | OpenList | CloseList | ElementAt | Cast, of: Column) -> Column:
        """Return what is made of one other column."""
        match typed:
            case FieldAccess():
                return Column(field_of(of.array(len(self)), typed.name), of.axes)
            case OpenList():
                elements, axis = open_list(of.array(len(self)))
                return Column(elements, (*of.axes, axis))
            case CloseList():
                return of.close_innermost()
            case ElementAt():
                return Column(_items(of.array(len(self)), typed.index), of.axes)
            case Cast():
                return _like(of, to_number(_array(of), typed.target, self.rejecter(of.axes, typed.text)))

    def _aligned(self, columns: list[Column], text: str) -> tuple[list[Column], tuple[Axis, ...]]:
        """Return the columns over the same elements; lists side by side must be of equal length."""
        axes = max((column.axes for column in columns), key=len, default=())
        for column in columns:
            for axis, other in zip(column.axes, axes, strict=False):
                if not axis.matches(other):
                    self._refuse_lengths(column.axes, axes, text)
        return [column.broadcast_to(axes) for column in columns], axes

    def _refuse_lengths(self, left: tuple[Axis, ...], right: tuple[Axis, ...], text: str) -> None:
        depth = next(i for i, (a, b) in enumerate(zip(left, right, strict=False)) if not a.matches(b))
        a, b = left[depth].lengths, right[depth].lengths
        taken, self._branch_conditions = (
            self._branch_conditions,
            [],
        )  # in branches that are not taken, too, the elements would be misaligned
        try:
            refuse = self.rejecter(left[:depth], text)
            refuse(a != b, "list-length", lambda i: f"lists of {a[i]} and {b[i]} elements")
        finally:
            self._branch_conditions = taken

    def _apply(self, typed: FunctionCall) -> Column:
        function = typed.function
        columns = [self.evaluate(argument) for argument in typed.arguments]
        columns, axes = self._aligned(columns, typed.text)
        count = len(axes[-1].parents) if axes else len(self)
        literal = all(isinstance(column.values, pa.Scalar) for column in columns)
        values: list[Array] = []
        for position, (column, argument) in enumerate(zip(columns, typed.arguments, strict=True)):
            take = function.parameter(position)
            if take.literal and isinstance(argument, Constant):
                values.append(argument.value)
                continue
            value = column.values
            if isinstance(value, pa.Scalar) and (not function.scalars or (literal and position == 0)):
                value = repeat(value, 1 if literal else count)
            values.append(value if take.prepare is None else take.prepare(value))
        if function.refuses:
            values.insert(0, self.rejecter(axes, typed.text))
        result = function.apply(*values)
        return Column(result[0]) if literal else Column(result, axes)

    def _list(self, typed: MakeList) -> Column:
        if not typed.items:
            return Column(arrays.array([[]] * len(self), typed.type.arrow))
        columns, axes = self._aligned([self.evaluate(item) for item in typed.items], typed.text)
        count = len(axes[-1].parents) if axes else len(self)
        items = promote(*(column.array(count) for column in columns))
        order = np.arange(count * len(items)).reshape(len(items), count).T.ravel()
        elements = arrays.concat_arrays(items).take(arrays.array(order))
        return Column(fixed_list(elements, len(items), None, count), axes)

    def _choice(self, typed: Conditional) -> Column:
        condition = self.evaluate(typed.condition)
        if pt.is_null(condition.values.type):
            condition = Column(arrays.scalar(None, arrays.bool_()))
        with self.within(condition):
            then = self.evaluate(typed.then)
        with self.within(Column(pc.invert(condition.values), condition.axes)):
            otherwise = self.evaluate(typed.otherwise)
        columns, axes = self._aligned([condition, then, otherwise], typed.text)
        chosen = columns[0].values
        branches = promote(columns[1].values, columns[2].values)
        if isinstance(chosen, pa.BooleanArray) and not chosen.null_count:
            taken = {0: branches[1], len(chosen): branches[0]}.get(chosen.true_count)
            if isinstance(taken, pa.Array):
                return Column(taken, axes)
        return Column(pc.if_else(chosen, *branches), axes)


def _scalar(typed: Constant) -> Array:
    if pt.is_floating(typed.type.arrow):
        return arrays.scalar(typed.value, arrays.float64())
    return arrays.scalar(typed.value, typed.type.arrow)


def _array(column: Column) -> Array:
    return repeat(column.values, 1) if isinstance(column.values, pa.Scalar) else column.values


def _like(column: Column, values: Array) -> Column:
    return Column(values[0] if isinstance(column.values, pa.Scalar) else values, column.axes)


def _items(lists: Array, index: int) -> Array:
    elements, axis = open_list(lists)
    starts, ends = axis.offsets[:-1], axis.offsets[1:]
    positions = starts + index if index >= 0 else ends + index
    absent = (positions < starts) | (positions >= ends)
    if axis.null is not None:
        absent = absent | axis.null
    if not absent.any():
        return elements.take(arrays.array(positions))
    return elements.take(arrays.array(np.where(absent, 0, positions), mask=absent))
