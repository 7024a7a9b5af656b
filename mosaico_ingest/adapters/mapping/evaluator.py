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
    one_type,
    open_list,
    pc,
    pt,
    repeat,
    true_where,
)
from mosaico_ingest.adapters.mapping.conversion import to_number
from mosaico_ingest.adapters.mapping.functions.registry import Refuse
from mosaico_ingest.adapters.mapping.typed import (
    Apply,
    Cast,
    ChoiceOf,
    Const,
    EachOf,
    FieldOf,
    Fold,
    ItemOf,
    ListValue,
    Typed,
    Whole,
)

__all__ = ["Evaluation", "Refusal", "RowsRefused"]


Refusal: TypeAlias = tuple[str, str]
"""The rule a row broke, and why."""


class RowsRefused(Exception):  # noqa: N818 - a signal: go on without these rows
    """Rows that do not fit; the caller evaluates the others again, without them."""

    def __init__(self, refusals: dict[int, Refusal]) -> None:
        super().__init__(f"{len(refusals)} rows")
        self.refusals = refusals


class Evaluation:
    """The values of expressions over one batch; each is computed once."""

    def __init__(self, rows: Array, envelope: Envelope) -> None:
        self.rows = rows
        self.envelope = envelope
        self.target = ""
        """The field being filled, for messages."""
        self._known: dict[Typed, Column] = {}
        self._taken: list[Column] = []
        """Conditions of the branches being evaluated: only rows where all hold count."""

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.rows)

    def of(self, typed: Typed) -> Column:
        """Return the values of an expression.

        Raises:
            RowsRefused: Some rows do not fit it.
        """
        known = self._known.get(typed)
        if known is None:
            known = self._compute(typed)
            if not self._taken:  # inside a branch, values of the rows that do not take it may be missing
                self._known[typed] = known
        return known

    def mask(self, typed: Typed) -> Mask:
        """Return where a condition without open lists holds."""
        values = self.of(typed).array(len(self))
        return true_where(pc.cast(values, arrays.bool_()))

    @contextmanager
    def within(self, condition: Column) -> Generator[None]:
        """Let only rows that take a branch reject themselves."""
        self._taken.append(condition)
        try:
            yield
        finally:
            self._taken.pop()

    def refuser(self, axes: tuple[Axis, ...], text: str | None) -> Refuse:
        """Return a way to reject the rows that elements belong to; without `text`, reasons stand as they are."""
        target = self.target

        def refuse(bad: Mask, rule: str, says: Callable[[int], str]) -> None:
            count = len(axes[-1].parents) if axes else len(self)
            single = len(bad) != count
            live = self._live(np.broadcast_to(bad, count), axes)
            if not live.any():
                return
            what = "" if text is None else f"{target}: " if text == target else f"{target}: `{text}`: "
            refusals: dict[int, Refusal] = {}
            positions = np.flatnonzero(live)
            rows = positions
            for axis in reversed(axes):
                rows = axis.parents[rows]
            for row, position in zip(rows.tolist(), positions.tolist(), strict=True):
                if row not in refusals:
                    refusals[row] = (rule, what + says(0 if single else position))
            raise RowsRefused(refusals)

        return refuse

    def _live(self, bad: Mask, axes: tuple[Axis, ...]) -> Mask:
        for condition in self._taken:
            if len(condition.axes) <= len(axes) and all(map(Axis.like, condition.axes, axes)):
                values = condition.over(axes).array(len(bad))
                bad = bad & true_where(values)
        return bad

    def _compute(self, typed: Typed) -> Column:
        match typed:
            case Whole():
                return Column(self.rows)
            case Const():
                return Column(_scalar(typed))
            case Apply():
                return self._apply(typed)
            case ListValue():
                return self._list(typed)
            case ChoiceOf():
                return self._choice(typed)
            case _:
                return self._derived(typed, self.of(typed.of))

    def _derived(self, typed: FieldOf | EachOf | Fold | ItemOf | Cast, of: Column) -> Column:
        """Return what is made of one other column."""
        match typed:
            case FieldOf():
                return Column(field_of(of.array(len(self)), typed.name), of.axes)
            case EachOf():
                elements, axis = open_list(of.array(len(self)))
                return Column(elements, (*of.axes, axis))
            case Fold():
                return of.folded()
            case ItemOf():
                return Column(_items(of.array(len(self)), typed.index), of.axes)
            case Cast():
                return _like(of, to_number(_array(of), typed.type, self.refuser(of.axes, typed.text)))

    def _aligned(self, columns: list[Column], text: str) -> tuple[list[Column], tuple[Axis, ...]]:
        """Return the columns over the same elements; lists side by side must be of equal length."""
        axes = max((column.axes for column in columns), key=len, default=())
        for column in columns:
            for axis, other in zip(column.axes, axes, strict=False):
                if not axis.like(other):
                    self._refuse_lengths(column.axes, axes, text)
        return [column.over(axes) for column in columns], axes

    def _refuse_lengths(self, left: tuple[Axis, ...], right: tuple[Axis, ...], text: str) -> None:
        depth = next(i for i, (a, b) in enumerate(zip(left, right, strict=False)) if not a.like(b))
        a, b = left[depth].lengths, right[depth].lengths
        taken, self._taken = (
            self._taken,
            [],
        )  # in branches that are not taken, too, the elements would be misaligned
        try:
            refuse = self.refuser(left[:depth], text)
            refuse(a != b, "list-length", lambda i: f"lists of {a[i]} and {b[i]} elements")
        finally:
            self._taken = taken

    def _apply(self, typed: Apply) -> Column:
        function = typed.function
        columns = [self.of(argument) for argument in typed.arguments]
        columns, axes = self._aligned(columns, typed.text)
        count = len(axes[-1].parents) if axes else len(self)
        literal = all(isinstance(column.values, pa.Scalar) for column in columns)
        values: list[Array] = []
        for position, (column, argument) in enumerate(zip(columns, typed.arguments, strict=True)):
            take = function.take(position)
            if take.literal and isinstance(argument, Const):
                values.append(argument.value)
                continue
            value = column.values
            if isinstance(value, pa.Scalar) and (not function.scalars or (literal and position == 0)):
                value = repeat(value, 1 if literal else count)
            values.append(value if take.prepare is None else take.prepare(value))
        if function.refuses:
            values.insert(0, self.refuser(axes, typed.text))
        result = function.apply(*values)
        return Column(result[0]) if literal else Column(result, axes)

    def _list(self, typed: ListValue) -> Column:
        if not typed.items:
            return Column(arrays.array([[]] * len(self), typed.kind.type))
        columns, axes = self._aligned([self.of(item) for item in typed.items], typed.text)
        count = len(axes[-1].parents) if axes else len(self)
        items = one_type(*(column.array(count) for column in columns))
        order = np.arange(count * len(items)).reshape(len(items), count).T.ravel()
        elements = arrays.concat_arrays(items).take(arrays.array(order))
        return Column(fixed_list(elements, len(items), None, count), axes)

    def _choice(self, typed: ChoiceOf) -> Column:
        condition = self.of(typed.condition)
        if pt.is_null(condition.values.type):
            condition = Column(arrays.scalar(None, arrays.bool_()))
        with self.within(condition):
            then = self.of(typed.then)
        with self.within(Column(pc.invert(condition.values), condition.axes)):
            otherwise = self.of(typed.otherwise)
        columns, axes = self._aligned([condition, then, otherwise], typed.text)
        chosen = columns[0].values
        branches = one_type(columns[1].values, columns[2].values)
        if isinstance(chosen, pa.BooleanArray) and not chosen.null_count:
            taken = {0: branches[1], len(chosen): branches[0]}.get(chosen.true_count)
            if isinstance(taken, pa.Array):
                return Column(taken, axes)
        return Column(pc.if_else(chosen, *branches), axes)


def _scalar(typed: Const) -> Array:
    if pt.is_floating(typed.kind.type):
        return arrays.scalar(typed.value, arrays.float64())
    return arrays.scalar(typed.value, typed.kind.type)


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
