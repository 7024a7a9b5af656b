"""The compiled record: a tree of column plans, and its evaluation over a batch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.adapter import Adapter, Envelope
from mosaico_ingest.adapters.mapping.columns import (
    Array,
    Axis,
    Column,
    DataType,
    Mask,
    arrays,
    null_mask,
    null_where,
    pc,
    promote,
    struct_of,
)
from mosaico_ingest.adapters.mapping.conversion import convert, refuse_nulls
from mosaico_ingest.adapters.mapping.evaluator import Evaluation, Rejection, RowsRejected
from mosaico_ingest.adapters.mapping.expressions import (
    TypedExpression,
)
from mosaico_ingest.adapters.mapping.functions.registry import RejectRows
from mosaico_ingest.ontology.types import NullRows

__all__ = [
    "ColumnPlan",
    "ColumnSource",
    "ExpressionSource",
    "MapLookup",
    "NestedAdapter",
    "NullColumn",
    "StructSource",
    "evaluate_column",
    "evaluate_struct",
]


class NullColumn(Struct, frozen=True):
    """Nothing: null in every row."""

    rows: NullRows


class ExpressionSource(Struct, frozen=True):
    """An expression."""

    expression: TypedExpression


class MapLookup(Struct, frozen=True):
    """A value looked up in a table."""

    operand: TypedExpression
    keys: Any
    """The values looked for, an Arrow array."""
    values: Any
    """What each becomes, an Arrow array."""
    otherwise: TypedExpression | None
    """For a value that is not there; None: the row is rejected."""


class NestedAdapter(Struct, frozen=True):
    """What another adapter makes of a nested message."""

    operand: TypedExpression
    adapter: Adapter
    name: str
    msgtype: str


class StructSource(Struct, frozen=True):
    """A struct, field by field; with `of`, names are read inside it."""

    operand: TypedExpression | None
    fields: tuple[ColumnPlan, ...]


ColumnSource: TypeAlias = "NullColumn | ExpressionSource | MapLookup | NestedAdapter | StructSource"


class ColumnPlan(Struct, frozen=True):
    """One column of the ontology and where it comes from."""

    path: str
    """Its name with those around it, as `pose.position`."""
    name: str
    type: DataType
    nullable: bool
    source: ColumnSource
    overrides: tuple[ColumnPlan, ...] = ()
    """Fields of the struct that come from elsewhere (`with`)."""
    when: TypedExpression | None = None


def evaluate_struct(evaluation: Evaluation, fields: tuple[ColumnPlan, ...], type_: DataType) -> Array:
    """Return a struct of all the fields, one value a row.

    Raises:
        RowsRefused: Some rows do not fit.
    """
    return struct_of([evaluate_column(evaluation, field) for field in fields], type_, None, len(evaluation))


def evaluate_column(evaluation: Evaluation, field: ColumnPlan) -> Array:
    """Return one column in its exact type, one value a row.

    Raises:
        RowsRefused: Some rows do not fit.
    """
    if field.when is None:
        array = _fill(evaluation, field)
    else:
        condition = evaluation.mask(field.when)
        with evaluation.within(Column(arrays.array(condition))):
            array = _fill(evaluation, field)
        array = null_where(array, ~condition)
    if field.nullable:
        return array
    evaluation.target = field.path
    return refuse_nulls(array, None, evaluation.rejecter((), field.path))


def _fill(evaluation: Evaluation, field: ColumnPlan) -> Array:
    evaluation.target = field.path
    source = field.source
    if isinstance(source, ExpressionSource) and not field.overrides:
        column = evaluation.evaluate(source.expression)
        types = _types(field.type, column.axes)
        values = _converted(evaluation, column, types[-1], source.expression.text)
    elif isinstance(source, NullColumn):
        return source.rows.of(len(evaluation))
    else:
        column = _base(evaluation, field)
        types = _types(field.type, column.axes)
        values = _replaced(evaluation, field, column, types[-1])
    for axis, type_ in zip(reversed(column.axes), reversed(types[:-1]), strict=True):
        values = _closed(axis, values, type_, evaluation.rejecter(column.axes[:-1], field.path))
    return values


def _types(target: DataType, axes: tuple[Axis, ...]) -> list[DataType]:
    """Return the type of the column and of the elements of each list opened, outermost first."""
    types = [target]
    for _ in axes:
        types.append(types[-1].value_type)
    return types


def _closed(axis: Axis, values: Array, type_: DataType, refuse: RejectRows) -> Array:
    same = axis.size is None and not hasattr(type_, "list_size")
    if same or axis.size == getattr(type_, "list_size", None):
        return axis.close(values, type_)
    return convert(axis.close(values), type_, refuse)


def _converted(evaluation: Evaluation, column: Column, target: DataType, text: str) -> Array:
    count = len(column.axes[-1].parents) if column.axes else len(evaluation)
    return convert(column.array(count), target, evaluation.rejecter(column.axes, text))


def _base(evaluation: Evaluation, field: ColumnPlan) -> Column:
    """Return the values before `with`, already in the element's type."""
    source = field.source
    match source:
        case NullColumn():
            return Column(source.rows.of(len(evaluation)))
        case ExpressionSource():
            column = evaluation.evaluate(source.expression)
            element = _types(field.type, column.axes)[-1]
            return Column(_converted(evaluation, column, element, source.expression.text), column.axes)
        case MapLookup():
            column = _looked_up(evaluation, source)
            element = _types(field.type, column.axes)[-1]
            return Column(_converted(evaluation, column, element, source.operand.text), column.axes)
        case NestedAdapter():
            column = evaluation.evaluate(source.operand)
            refuse = evaluation.rejecter(column.axes, source.operand.text)
            run = _adapting(evaluation, source, column)
            return Column(
                _over_valid(column.array(0), _types(field.type, column.axes)[-1], run, refuse), column.axes
            )
        case StructSource():
            return _by_fields(evaluation, field, source)


def _by_fields(evaluation: Evaluation, field: ColumnPlan, source: StructSource) -> Column:
    if source.operand is None:
        return Column(evaluate_struct(evaluation, source.fields, field.type))
    column = evaluation.evaluate(source.operand)
    element = _types(field.type, column.axes)[-1]

    def run(rows: Array, positions: Mask) -> Array:
        inner = Evaluation(rows, _envelope(evaluation.envelope, column.axes, positions))
        return evaluate_struct(inner, source.fields, element)

    refuse = evaluation.rejecter(column.axes, None)
    return Column(_over_valid(column.array(0), element, run, refuse), column.axes)


def _envelope(envelope: Envelope, axes: tuple[Axis, ...], rows: Any) -> Envelope:  # noqa: ANN401 - row positions
    for axis in reversed(axes):
        rows = axis.parents[rows]
    return replace(envelope, log_times=envelope.log_times[rows])


def _adapting(evaluation: Evaluation, source: NestedAdapter, column: Column) -> Callable[[Array, Any], Array]:
    def run(rows: Array, positions: Mask) -> Array:
        envelope = _envelope(evaluation.envelope, column.axes, positions)
        adapted = source.adapter.adapt(rows, replace(envelope, msgtype=source.msgtype))
        if adapted.failures:
            raise RowsRejected({f.row: (f.rule, f"{source.name}: {f.reason}") for f in adapted.failures})
        return adapted.rows

    return run


def _over_valid(
    rows: Array, type_: DataType, run: Callable[[Array, Any], Array], refuse: RejectRows
) -> Array:
    """Run over the rows that are not null, and leave out those that are refused but do not count."""
    absent = null_mask(rows)
    good = np.ones(len(rows), bool) if absent is None else ~absent
    while True:
        positions = np.flatnonzero(good)
        try:
            result = run(rows if good.all() else rows.filter(arrays.array(good)), positions)
            break
        except RowsRejected as refused:
            said = {int(positions[row]): why for row, why in refused.refusals.items()}
            _refuse_each(said, len(rows), refuse)
            good[list(said)] = False
    result = convert(result, type_, refuse)
    if good.all():
        return result
    where = np.full(len(rows), -1, np.int64)
    where[positions] = np.arange(len(positions))
    return result.take(arrays.array(np.maximum(where, 0), mask=where < 0))


def _refuse_each(said: dict[int, Rejection], count: int, refuse: RejectRows) -> None:
    """Hand on refusals of elements, those of one rule together."""
    for rule in dict.fromkeys(rule for rule, _ in said.values()):
        bad = np.zeros(count, bool)
        bad[[row for row, (own, _) in said.items() if own == rule]] = True
        refuse(bad, rule, lambda i: said[i][1])


def _looked_up(evaluation: Evaluation, source: MapLookup) -> Column:
    column = evaluation.evaluate(source.operand)
    count = len(column.axes[-1].parents) if column.axes else len(evaluation)
    values = column.array(count)
    index = pc.index_in(values, value_set=pc.cast(source.keys, values.type))
    found = source.values.take(index)
    unknown = np.asarray(pc.and_(pc.is_null(index), pc.is_valid(values)))
    if not unknown.any():
        return Column(found, column.axes)
    if source.otherwise is None:
        known = ", ".join(str(key) for key in source.keys.to_pylist())
        refuse = evaluation.rejecter(column.axes, source.operand.text)
        refuse(unknown, "unmapped", lambda i: f"{values[i].as_py()!r} is not in the map ({known})")
        return Column(found, column.axes)
    with evaluation.within(Column(arrays.array(unknown), column.axes)):
        rest = evaluation.evaluate(source.otherwise).broadcast_to(column.axes).array(count)
    found, rest = promote(found, rest)
    return Column(pc.if_else(arrays.array(unknown), rest, found), column.axes)


def _replaced(evaluation: Evaluation, field: ColumnPlan, column: Column, type_: DataType) -> Array:
    """Return the struct with the fields of `with` in place."""
    struct = column.values
    if not field.overrides:
        return struct
    children = [struct.field(i) for i in range(type_.num_fields)]
    for replaced in field.overrides:
        value = Column(evaluate_column(evaluation, replaced)).broadcast_to(column.axes).array(0)
        children[type_.get_field_index(replaced.name)] = value
    return struct_of(children, type_, null_mask(struct), len(struct))
