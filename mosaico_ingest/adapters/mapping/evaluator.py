"""The compiled record: a tree of column plans with typed expressions, and its evaluation over a batch."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from mosaico_ingest.adapters.adapter import Adapter, Envelope
from mosaico_ingest.adapters.mapping.columns import (
    Array,
    Axis,
    Column,
    DataType,
    Mask,
    arrays,
    field_of,
    fixed_list,
    null_mask,
    null_where,
    open_list,
    pc,
    promote,
    pt,
    repeat,
    struct_of,
    true_mask,
)
from mosaico_ingest.adapters.mapping.conversion import convert, refuse_nulls, to_number
from mosaico_ingest.adapters.mapping.expressions import (
    Cast,
    CloseList,
    Conditional,
    Constant,
    ElementAt,
    EnvelopeField,
    FieldAccess,
    FunctionCall,
    MakeList,
    MessageRef,
    OpenList,
    OuterValue,
    TypedExpression,
)
from mosaico_ingest.adapters.mapping.functions.registry import Function, RejectRows
from mosaico_ingest.ontology.registry import NullRows

Rejection: TypeAlias = tuple[str, str]
"""The rule that a row violates, and the reason."""


class RowsRejected(Exception):  # noqa: N818 - control flow: the caller retries without these rows
    """Some rows are invalid; the caller evaluates the batch again without them."""

    def __init__(self, rejections: dict[int, Rejection]) -> None:
        super().__init__(f"{len(rejections)} rows")
        self.rejections = rejections


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


class Evaluation:
    """The values of expressions over one batch; equal expressions are computed once."""

    def __init__(
        self,
        rows: Array,
        envelope: Envelope,
        *,
        outer: Evaluation | None = None,
        parents: NDArray[np.int64] | None = None,
    ) -> None:
        """Prepare the evaluation of a batch; `parents` is the row of `outer` to which each nested message belongs."""
        self.rows = rows
        self.envelope = envelope
        self._outer = outer
        self._parents = np.arange(len(rows)) if parents is None else parents
        self.target = ""
        """The path of the column being evaluated, for messages."""
        self._cache: dict[TypedExpression, Column] = {}
        self._branch_conditions: list[Column] = []
        """Conditions of the branches being evaluated; only rows that fulfill all of them can be rejected."""

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.rows)

    def evaluate(self, typed: TypedExpression) -> Column:
        """Return the values of an expression.

        Raises:
            RowsRejected: The expression has no value for some rows.
        """
        column = self._cache.get(typed)
        if column is None:
            column = self._compute(typed)
            # Inside a branch, rows that do not take it may have invalid values.
            if not self._branch_conditions:
                self._cache[typed] = column
        return column

    def enclosing(self, levels: int) -> tuple[Evaluation, NDArray[np.int64]]:
        """Return an enclosing evaluation, and the row in it to which each row belongs."""
        if levels == 0 or self._outer is None:
            return self, np.arange(len(self))
        outer, parents = self._outer.enclosing(levels - 1)
        return outer, parents[self._parents]

    def subset(self, accepted: Mask) -> Evaluation:
        """Return the evaluation of some rows."""
        return Evaluation(
            self.rows.filter(arrays.array(accepted)),
            self.envelope.take(accepted),
            outer=self._outer,
            parents=self._parents[accepted],
        )

    def count(self, axes: tuple[Axis, ...]) -> int:
        """Return the number of values below some axes; without axes, the number of rows."""
        return len(axes[-1].parents) if axes else len(self)

    def mask(self, typed: TypedExpression) -> Mask:
        """Return where a condition without open lists is true; null counts as false."""
        values = self.evaluate(typed).array(len(self))
        return true_mask(pc.cast(values, arrays.bool_()))

    @contextmanager
    def within(self, condition: Column) -> Generator[None]:
        """Restrict rejections to the rows where `condition` is true."""
        self._branch_conditions.append(condition)
        try:
            yield
        finally:
            self._branch_conditions.pop()

    def rejecter(self, axes: tuple[Axis, ...], text: str | None) -> RejectRows:
        """Return a callback that rejects the rows of invalid elements; `text` is the expression to name in the reason.

        Without `text`, the reasons are used unchanged, because an inner evaluation has completed them.
        """
        target = self.target

        def refuse(bad: Mask, rule: str, reason: Callable[[int], str]) -> None:
            count = self.count(axes)
            is_literal = len(bad) != count
            rejected = self._in_selected_branches(np.broadcast_to(bad, count), axes)
            if not rejected.any():
                return
            prefix = "" if text is None else f"{target}: " if text == target else f"{target}: `{text}`: "
            rejections: dict[int, Rejection] = {}
            positions = np.flatnonzero(rejected)
            rows = positions
            for axis in reversed(axes):
                rows = axis.parents[rows]
            for row, position in zip(rows.tolist(), positions.tolist(), strict=True):
                if row not in rejections:
                    rejections[row] = (rule, prefix + reason(0 if is_literal else position))
            raise RowsRejected(rejections)

        return refuse

    def _in_selected_branches(self, bad: Mask, axes: tuple[Axis, ...]) -> Mask:
        for condition in self._branch_conditions:
            if len(condition.axes) <= len(axes) and all(map(Axis.matches, condition.axes, axes)):
                values = condition.broadcast_to(axes).array(len(bad))
                bad = bad & true_mask(values)
        return bad

    def _compute(self, typed: TypedExpression) -> Column:
        match typed:
            case MessageRef() | Constant() | EnvelopeField():
                return self._leaf(typed)
            case OuterValue():
                return self._outer_value(typed)
            case FunctionCall():
                return self._call(typed)
            case MakeList():
                return self._list(typed)
            case Conditional():
                return self._conditional(typed)
            case _:
                return self._unary(typed, self.evaluate(typed.operand))

    def _unary(self, typed: FieldAccess | OpenList | CloseList | ElementAt | Cast, operand: Column) -> Column:
        """Evaluate a node with one operand."""
        match typed:
            case FieldAccess():
                return Column(field_of(operand.array(len(self)), typed.name), operand.axes)
            case OpenList():
                elements, axis = open_list(operand.array(len(self)))
                return Column(elements, (*operand.axes, axis))
            case CloseList():
                return operand.close_innermost()
            case ElementAt():
                return Column(_element_at(operand.array(len(self)), typed.index), operand.axes)
            case Cast():
                return _like(
                    operand,
                    to_number(_as_array(operand), typed.target, self.rejecter(operand.axes, typed.text)),
                )

    def _leaf(self, typed: MessageRef | Constant | EnvelopeField) -> Column:
        """Evaluate a node without operands."""
        match typed:
            case MessageRef():
                return Column(self.rows)
            case Constant():
                return Column(_scalar(typed))
            case EnvelopeField(name="topic"):
                return Column(arrays.scalar(self.envelope.topic, arrays.string()))
            case EnvelopeField(name="sequence"):
                numbers = self.envelope.sequences
                numbers = np.zeros(len(self), np.int64) if numbers is None else numbers
                return Column(arrays.array(numbers.astype(np.uint32)))
            case EnvelopeField():
                published = self.envelope.publish_times if typed.name == "publish_time" else None
                return Column(arrays.array(self.envelope.log_times if published is None else published))

    def _outer_value(self, typed: OuterValue) -> Column:
        """Return a value of an enclosing evaluation for each row; rows are rejected like those they belong to."""
        outer, parents = self.enclosing(typed.levels)
        accepted = np.ones(len(outer), bool)
        rejections: dict[int, Rejection] = {}
        while True:
            index = np.flatnonzero(accepted)
            part = outer if accepted.all() else outer.subset(accepted)
            try:
                values = part.evaluate(typed.operand).close_all(len(part))
                break
            except RowsRejected as error:
                rejected = {int(index[row]): rejection for row, rejection in error.rejections.items()}
                rejections |= rejected
                accepted[list(rejected)] = False
        if not rejections:
            return Column(values.take(arrays.array(parents)))
        of_rows = {
            row: rejections[parent] for row, parent in enumerate(parents.tolist()) if parent in rejections
        }
        reject_by_rule(of_rows, len(self), self.rejecter((), None))
        positions = np.full(len(outer), -1, np.int64)
        positions[index] = np.arange(len(index))
        positions = positions[parents]
        return Column(values.take(arrays.array(np.maximum(positions, 0), mask=positions < 0)))

    def _aligned(self, columns: list[Column], text: str) -> tuple[list[Column], tuple[Axis, ...]]:
        """Broadcast columns to the same axes; rows whose lists differ in length are rejected."""
        axes = max((column.axes for column in columns), key=len, default=())
        for column in columns:
            for axis, other in zip(column.axes, axes, strict=False):
                if not axis.matches(other):
                    self._reject_lengths(column.axes, axes, text)
        return [column.broadcast_to(axes) for column in columns], axes

    def _reject_lengths(self, left: tuple[Axis, ...], right: tuple[Axis, ...], text: str) -> None:
        depth = next(i for i, (a, b) in enumerate(zip(left, right, strict=False)) if not a.matches(b))
        a, b = left[depth].lengths, right[depth].lengths
        # Misaligned elements invalidate the complete column, so branches that are not taken count here, too.
        conditions, self._branch_conditions = self._branch_conditions, []
        try:
            refuse = self.rejecter(left[:depth], text)
            refuse(a != b, "list-length", lambda i: f"lists of {a[i]} and {b[i]} elements")
        finally:
            self._branch_conditions = conditions

    def _call(self, typed: FunctionCall) -> Column:
        function = typed.function
        columns = [self.evaluate(argument) for argument in typed.arguments]
        columns, axes = self._aligned(columns, typed.text)
        count = self.count(axes)
        all_literals = all(isinstance(column.values, pa.Scalar) for column in columns)
        arguments: list[Array] = []
        for position, (column, argument) in enumerate(zip(columns, typed.arguments, strict=True)):
            parameter = function.parameter(position)
            if parameter.literal and isinstance(argument, Constant):
                arguments.append(argument.value)
                continue
            value = column.values
            if isinstance(value, pa.Scalar) and (not function.scalars or (all_literals and position == 0)):
                value = repeat(value, 1 if all_literals else count)
            arguments.append(value if parameter.prepare is None else parameter.prepare(value))
        self._check_elements(function, arguments, axes, typed.text)
        if function.refuses:
            arguments.insert(0, self.rejecter(axes, typed.text))
        result = function.apply(*arguments)
        return Column(result[0]) if all_literals else Column(result, axes)

    def _check_elements(
        self, function: Function, arguments: list[Array], axes: tuple[Axis, ...], text: str
    ) -> None:
        """Reject rows in which an argument about the elements of the first one has another number of them."""
        positions = [i for i in range(1, len(arguments)) if function.parameter(i).of_elements]
        if not positions:
            return
        elements = open_list(arguments[0])[1]
        for position in positions:
            axis = open_list(arguments[position])[1]
            if not axis.matches(elements):
                self._reject_lengths((*axes, axis), (*axes, elements), text)

    def _list(self, typed: MakeList) -> Column:
        if not typed.items:
            return Column(arrays.array([[]] * len(self), typed.type.arrow))
        columns, axes = self._aligned([self.evaluate(item) for item in typed.items], typed.text)
        count = self.count(axes)
        items = promote(*(column.array(count) for column in columns))
        order = np.arange(count * len(items)).reshape(len(items), count).T.ravel()
        elements = arrays.concat_arrays(items).take(arrays.array(order))
        return Column(fixed_list(elements, len(items), None, count), axes)

    def _conditional(self, typed: Conditional) -> Column:
        condition = self.evaluate(typed.condition)
        if pt.is_null(condition.values.type):
            condition = Column(arrays.scalar(None, arrays.bool_()))
        with self.within(condition):
            then = self.evaluate(typed.then)
        with self.within(Column(pc.invert(condition.values), condition.axes)):
            otherwise = self.evaluate(typed.otherwise)
        columns, axes = self._aligned([condition, then, otherwise], typed.text)
        mask = columns[0].values
        branches = promote(columns[1].values, columns[2].values)
        if isinstance(mask, pa.BooleanArray) and not mask.null_count:
            only = {0: branches[1], len(mask): branches[0]}.get(mask.true_count)
            if isinstance(only, pa.Array):
                return Column(only, axes)
        return Column(pc.if_else(mask, *branches), axes)


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


def reject_by_rule(rejections: Mapping[int, Rejection], count: int, refuse: RejectRows) -> None:
    """Reject elements, with one call per rule."""
    for rule in dict.fromkeys(rule for rule, _ in rejections.values()):
        bad = np.zeros(count, bool)
        bad[[row for row, (own, _) in rejections.items() if own == rule]] = True
        refuse(bad, rule, lambda i: rejections[i][1])


def _scalar(typed: Constant) -> Array:
    """Return a literal as an Arrow scalar; floats are computed in 64 bits, regardless of their type."""
    if pt.is_floating(typed.type.arrow):
        return arrays.scalar(typed.value, arrays.float64())
    return arrays.scalar(typed.value, typed.type.arrow)


def _as_array(column: Column) -> Array:
    return repeat(column.values, 1) if isinstance(column.values, pa.Scalar) else column.values


def _like(column: Column, values: Array) -> Column:
    """Return values of the shape of a column: a scalar if the column is one."""
    return Column(values[0] if isinstance(column.values, pa.Scalar) else values, column.axes)


def _element_at(lists: Array, index: int) -> Array:
    """Return one element of every list, null if the list is too short."""
    elements, axis = open_list(lists)
    starts, ends = axis.offsets[:-1], axis.offsets[1:]
    positions = starts + index if index >= 0 else ends + index
    absent = (positions < starts) | (positions >= ends)
    if axis.null is not None:
        absent = absent | axis.null
    if not absent.any():
        return elements.take(arrays.array(positions))
    return elements.take(arrays.array(np.where(absent, 0, positions), mask=absent))


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
