"""The compiled record: a tree of column plans, and its evaluation over a batch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.adapter import Adapter
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
from mosaico_ingest.adapters.mapping.evaluator import Evaluation, RowsRejected, reject_by_rule
from mosaico_ingest.adapters.mapping.expressions import TypedExpression
from mosaico_ingest.adapters.mapping.functions.registry import RejectRows
from mosaico_ingest.ontology.types import NullRows


class NullColumn(Struct, frozen=True):
    """Null in every row."""

    rows: NullRows


class ExpressionSource(Struct, frozen=True):
    """The values of an expression."""

    expression: TypedExpression


class MapLookup(Struct, frozen=True):
    """The values of an expression, replaced according to a table (`map`)."""

    operand: TypedExpression
    keys: Any
    """An Arrow array of the values to replace."""
    values: Any
    """An Arrow array of the replacements."""
    otherwise: TypedExpression | None
    """Replaces values that are not in the table; None rejects their rows."""


class NestedAdapter(Struct, frozen=True):
    """The records that another adapter makes of nested messages (`use`)."""

    operand: TypedExpression
    adapter: Adapter
    name: str
    msgtype: str


class StructSource(Struct, frozen=True):
    """A struct with one plan per field (`fields`)."""

    operand: TypedExpression | None
    """The nested message in which names are looked up (`of`)."""
    fields: tuple[ColumnPlan, ...]


ColumnSource: TypeAlias = "NullColumn | ExpressionSource | MapLookup | NestedAdapter | StructSource"


class ColumnPlan(Struct, frozen=True):
    """One column of the record, or a field of a struct column, and the source of its values."""

    path: str
    """The column's path, such as `pose.position`."""
    name: str
    type: DataType
    nullable: bool
    source: ColumnSource
    overrides: tuple[ColumnPlan, ...] = ()
    """Fields of the struct that have another source (`with`)."""
    when: TypedExpression | None = None
    """The column is null in rows where this condition is not true."""


def evaluate_column(evaluation: Evaluation, plan: ColumnPlan) -> Array:
    """Return one column in its exact type, one value per row.

    Raises:
        RowsRejected: Some rows do not fit.
    """
    if plan.when is None:
        values = _evaluate(evaluation, plan)
    else:
        condition = evaluation.mask(plan.when)
        with evaluation.within(Column(arrays.array(condition))):
            values = _evaluate(evaluation, plan)
        values = null_where(values, ~condition)
    if plan.nullable:
        return values
    evaluation.target = plan.path
    return refuse_nulls(values, None, evaluation.rejecter((), plan.path))


def evaluate_struct(evaluation: Evaluation, plans: tuple[ColumnPlan, ...], type_: DataType) -> Array:
    """Return a struct column with one field per plan, one value per row.

    Raises:
        RowsRejected: Some rows do not fit.
    """
    return struct_of([evaluate_column(evaluation, plan) for plan in plans], type_, None, len(evaluation))


def _evaluate(evaluation: Evaluation, plan: ColumnPlan) -> Array:
    evaluation.target = plan.path
    column = _evaluate_source(evaluation, plan)
    types = _nested_types(plan.type, column.axes)
    values = _with_overrides(evaluation, plan, column, types[-1])
    for axis, type_ in zip(reversed(column.axes), reversed(types[:-1]), strict=True):
        values = _close_list(axis, values, type_, evaluation.rejecter(column.axes[:-1], plan.path))
    return values


def _evaluate_source(evaluation: Evaluation, plan: ColumnPlan) -> Column:
    """Return the values of a plan's source in the type of the innermost elements, before `with`."""
    source = plan.source
    match source:
        case NullColumn():
            return Column(source.rows.of(len(evaluation)))
        case ExpressionSource():
            column = evaluation.evaluate(source.expression)
            return _converted(evaluation, column, plan.type, source.expression.text)
        case MapLookup():
            column = _look_up(evaluation, source)
            return _converted(evaluation, column, plan.type, source.operand.text)
        case NestedAdapter():
            column = evaluation.evaluate(source.operand)
            return _nested(
                evaluation, column, plan.type, _adapt(evaluation, source, column), source.operand.text
            )
        case StructSource():
            if source.operand is None:
                return Column(evaluate_struct(evaluation, source.fields, plan.type))
            column = evaluation.evaluate(source.operand)
            element = _nested_types(plan.type, column.axes)[-1]

            def evaluate_fields(rows: Array, positions: Mask) -> Array:
                parents = row_of(column.axes, positions)
                envelope = evaluation.envelope.take(parents)
                inner = Evaluation(rows, envelope, outer=evaluation, parents=parents)
                return evaluate_struct(inner, source.fields, element)

            return _nested(evaluation, column, plan.type, evaluate_fields, None)


def _converted(evaluation: Evaluation, column: Column, target: DataType, text: str) -> Column:
    element = _nested_types(target, column.axes)[-1]
    values = column.array(evaluation.count(column.axes))
    return Column(convert(values, element, evaluation.rejecter(column.axes, text)), column.axes)


def _nested_types(target: DataType, axes: tuple[Axis, ...]) -> list[DataType]:
    """Return the type of the column, followed by the element types of its open lists, outermost first."""
    types = [target]
    for _ in axes:
        types.append(types[-1].value_type)
    return types


def _close_list(axis: Axis, values: Array, type_: DataType, refuse: RejectRows) -> Array:
    if axis.size == getattr(type_, "list_size", None):
        return axis.close(values, type_)
    return convert(axis.close(values), type_, refuse)


def _nested(
    evaluation: Evaluation,
    column: Column,
    target: DataType,
    run: Callable[[Array, Any], Array],
    text: str | None,
) -> Column:
    """Run an inner evaluation over the messages of a column that are not null.

    Messages that are rejected are excluded, unless their rejection rejects the outer row.
    """
    messages, refuse = column.array(0), evaluation.rejecter(column.axes, text)
    absent = null_mask(messages)
    selected = np.ones(len(messages), bool) if absent is None else ~absent
    while True:
        positions = np.flatnonzero(selected)
        try:
            result = run(messages if selected.all() else messages.filter(arrays.array(selected)), positions)
            break
        except RowsRejected as error:
            rejections = {int(positions[row]): rejection for row, rejection in error.rejections.items()}
            reject_by_rule(rejections, len(messages), refuse)
            selected[list(rejections)] = False
    result = convert(result, _nested_types(target, column.axes)[-1], refuse)
    if not selected.all():
        indices = np.full(len(messages), -1, np.int64)
        indices[positions] = np.arange(len(positions))
        result = result.take(arrays.array(np.maximum(indices, 0), mask=indices < 0))
    return Column(result, column.axes)


def _adapt(evaluation: Evaluation, source: NestedAdapter, column: Column) -> Callable[[Array, Any], Array]:
    def run(rows: Array, positions: Mask) -> Array:
        envelope = evaluation.envelope.take(row_of(column.axes, positions))
        adapted = source.adapter.adapt(rows, replace(envelope, msgtype=source.msgtype))
        if adapted.failures:
            raise RowsRejected({f.row: (f.rule, f"{source.name}: {f.reason}") for f in adapted.failures})
        return adapted.rows

    return run


def row_of(axes: tuple[Axis, ...], positions: Any) -> Any:  # noqa: ANN401 - arrays of numpy
    """Return the row of each element at some positions below open lists."""
    for axis in reversed(axes):
        positions = axis.parents[positions]
    return positions


def _look_up(evaluation: Evaluation, source: MapLookup) -> Column:
    column = evaluation.evaluate(source.operand)
    count = evaluation.count(column.axes)
    values = column.array(count)
    index = pc.index_in(values, value_set=pc.cast(source.keys, values.type))
    replaced = source.values.take(index)
    unknown = np.asarray(pc.and_(pc.is_null(index), pc.is_valid(values)))
    if not unknown.any():
        return Column(replaced, column.axes)
    if source.otherwise is None:
        keys = ", ".join(str(key) for key in source.keys.to_pylist())
        refuse = evaluation.rejecter(column.axes, source.operand.text)
        refuse(unknown, "unmapped", lambda i: f"{values[i].as_py()!r} is not in the map ({keys})")
        return Column(replaced, column.axes)
    with evaluation.within(Column(arrays.array(unknown), column.axes)):
        default = evaluation.evaluate(source.otherwise).broadcast_to(column.axes).array(count)
    replaced, default = promote(replaced, default)
    return Column(pc.if_else(arrays.array(unknown), default, replaced), column.axes)


def _with_overrides(evaluation: Evaluation, plan: ColumnPlan, column: Column, type_: DataType) -> Array:
    """Return the values of a column, with the fields of `with` replaced."""
    struct = column.values
    if not plan.overrides:
        return struct
    children = [struct.field(i) for i in range(type_.num_fields)]
    for override in plan.overrides:
        value = Column(evaluate_column(evaluation, override)).broadcast_to(column.axes).array(0)
        children[type_.get_field_index(override.name)] = value
    return struct_of(children, type_, null_mask(struct), len(struct))
