"""This file is a compiled mapping: what fills each column of the ontology, and how a batch is put through it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from mosaico_ingest.adapters.adapter import Adapter, Envelope
from mosaico_ingest.adapters.mapping.arrow import Array, DataType, arrays, pc
from mosaico_ingest.adapters.mapping.columns import Axis, Column, Mask, null_where, nulls, one_type, struct_of
from mosaico_ingest.adapters.mapping.evaluate import Evaluation, Refusal, RowsRefused
from mosaico_ingest.adapters.mapping.fit import convert, refuse_nulls
from mosaico_ingest.adapters.mapping.functions.registry import Refuse
from mosaico_ingest.adapters.mapping.typed import Typed
from mosaico_ingest.frozen import frozen
from mosaico_ingest.ontology.required import AbsentRows

__all__ = ["Absent", "ByAdapter", "ByFields", "Computed", "Filled", "Looked", "Source", "fill", "fill_struct"]


@frozen
class Absent:
    """Nothing: null in every row."""

    rows: AbsentRows


@frozen
class Computed:
    """An expression."""

    typed: Typed


@frozen
class Looked:
    """A value looked up in a table."""

    typed: Typed
    keys: Any
    """The values looked for, an Arrow array."""
    values: Any
    """What each becomes, an Arrow array."""
    otherwise: Typed | None
    """For a value that is not there; None: the row is rejected."""


@frozen
class ByAdapter:
    """What another adapter makes of a nested message."""

    of: Typed
    adapter: Adapter
    name: str
    msgtype: str


@frozen
class ByFields:
    """A struct, field by field; with `of`, names are read inside it."""

    of: Typed | None
    fields: tuple[Filled, ...]


Source: TypeAlias = "Absent | Computed | Looked | ByAdapter | ByFields"


@frozen
class Filled:
    """One column of the ontology and where it comes from."""

    path: str
    """Its name with those around it, as `pose.position`."""
    name: str
    type: DataType
    nullable: bool
    source: Source
    replaced: tuple[Filled, ...] = ()
    """Fields of the struct that come from elsewhere (`with`)."""
    when: Typed | None = None


def fill_struct(evaluation: Evaluation, fields: tuple[Filled, ...], type_: DataType) -> Array:
    """Return a struct of all the fields, one value a row.

    Raises:
        RowsRefused: Some rows do not fit.
    """
    return struct_of([fill(evaluation, field) for field in fields], type_, None, len(evaluation))


def fill(evaluation: Evaluation, field: Filled) -> Array:
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
    return refuse_nulls(array, None, evaluation.refuser((), field.path))


def _fill(evaluation: Evaluation, field: Filled) -> Array:
    evaluation.target = field.path
    source = field.source
    if isinstance(source, Computed) and not field.replaced:
        column = evaluation.of(source.typed)
        types = _types(field.type, column.axes)
        values = _converted(evaluation, column, types[-1], source.typed.text)
    elif isinstance(source, Absent):
        return source.rows.of(len(evaluation))
    else:
        column = _base(evaluation, field)
        types = _types(field.type, column.axes)
        values = _replaced(evaluation, field, column, types[-1])
    for axis, type_ in zip(reversed(column.axes), reversed(types[:-1]), strict=True):
        values = _closed(axis, values, type_, evaluation.refuser(column.axes[:-1], field.path))
    return values


def _types(target: DataType, axes: tuple[Axis, ...]) -> list[DataType]:
    """Return the type of the column and of the elements of each list opened, outermost first."""
    types = [target]
    for _ in axes:
        types.append(types[-1].value_type)
    return types


def _closed(axis: Axis, values: Array, type_: DataType, refuse: Refuse) -> Array:
    same = axis.size is None and not hasattr(type_, "list_size")
    if same or axis.size == getattr(type_, "list_size", None):
        return axis.close(values, type_)
    return convert(axis.close(values), type_, refuse)


def _converted(evaluation: Evaluation, column: Column, target: DataType, text: str) -> Array:
    count = len(column.axes[-1].parents) if column.axes else len(evaluation)
    return convert(column.array(count), target, evaluation.refuser(column.axes, text))


def _base(evaluation: Evaluation, field: Filled) -> Column:
    """Return the values before `with`, already in the element's type."""
    source = field.source
    match source:
        case Absent():
            return Column(source.rows.of(len(evaluation)))
        case Computed():
            column = evaluation.of(source.typed)
            element = _types(field.type, column.axes)[-1]
            return Column(_converted(evaluation, column, element, source.typed.text), column.axes)
        case Looked():
            column = _looked_up(evaluation, source)
            element = _types(field.type, column.axes)[-1]
            return Column(_converted(evaluation, column, element, source.typed.text), column.axes)
        case ByAdapter():
            column = evaluation.of(source.of)
            refuse = evaluation.refuser(column.axes, source.of.text)
            run = _adapting(evaluation, source, column)
            return Column(
                _over_valid(column.array(0), _types(field.type, column.axes)[-1], run, refuse), column.axes
            )
        case ByFields():
            return _by_fields(evaluation, field, source)


def _by_fields(evaluation: Evaluation, field: Filled, source: ByFields) -> Column:
    if source.of is None:
        return Column(fill_struct(evaluation, source.fields, field.type))
    column = evaluation.of(source.of)
    element = _types(field.type, column.axes)[-1]

    def run(rows: Array, positions: Mask) -> Array:
        inner = Evaluation(rows, _envelope(evaluation.envelope, column.axes, positions))
        return fill_struct(inner, source.fields, element)

    refuse = evaluation.refuser(column.axes, None)
    return Column(_over_valid(column.array(0), element, run, refuse), column.axes)


def _envelope(envelope: Envelope, axes: tuple[Axis, ...], rows: Any) -> Envelope:  # noqa: ANN401 - row positions
    for axis in reversed(axes):
        rows = axis.parents[rows]
    return replace(envelope, log_times=envelope.log_times[rows])


def _adapting(evaluation: Evaluation, source: ByAdapter, column: Column) -> Callable[[Array, Any], Array]:
    def run(rows: Array, positions: Mask) -> Array:
        envelope = _envelope(evaluation.envelope, column.axes, positions)
        adapted = source.adapter.adapt(rows, replace(envelope, msgtype=source.msgtype))
        if adapted.failures:
            raise RowsRefused({f.row: (f.rule, f"{source.name}: {f.reason}") for f in adapted.failures})
        return adapted.rows

    return run


def _over_valid(rows: Array, type_: DataType, run: Callable[[Array, Any], Array], refuse: Refuse) -> Array:
    """Run over the rows that are not null, and leave out those that are refused but do not count."""
    absent = nulls(rows)
    good = np.ones(len(rows), bool) if absent is None else ~absent
    while True:
        positions = np.flatnonzero(good)
        try:
            result = run(rows if good.all() else rows.filter(arrays.array(good)), positions)
            break
        except RowsRefused as refused:
            said = {int(positions[row]): why for row, why in refused.refusals.items()}
            _refuse_each(said, len(rows), refuse)
            good[list(said)] = False
    result = convert(result, type_, refuse)
    if good.all():
        return result
    where = np.full(len(rows), -1, np.int64)
    where[positions] = np.arange(len(positions))
    return result.take(arrays.array(np.maximum(where, 0), mask=where < 0))


def _refuse_each(said: dict[int, Refusal], count: int, refuse: Refuse) -> None:
    """Hand on refusals of elements, those of one rule together."""
    for rule in dict.fromkeys(rule for rule, _ in said.values()):
        bad = np.zeros(count, bool)
        bad[[row for row, (own, _) in said.items() if own == rule]] = True
        refuse(bad, rule, lambda i: said[i][1])


def _looked_up(evaluation: Evaluation, source: Looked) -> Column:
    column = evaluation.of(source.typed)
    count = len(column.axes[-1].parents) if column.axes else len(evaluation)
    values = column.array(count)
    index = pc.index_in(values, value_set=pc.cast(source.keys, values.type))
    found = source.values.take(index)
    unknown = np.asarray(pc.and_(pc.is_null(index), pc.is_valid(values)))
    if not unknown.any():
        return Column(found, column.axes)
    if source.otherwise is None:
        known = ", ".join(str(key) for key in source.keys.to_pylist())
        refuse = evaluation.refuser(column.axes, source.typed.text)
        refuse(unknown, "unmapped", lambda i: f"{values[i].as_py()!r} is not in the map ({known})")
        return Column(found, column.axes)
    with evaluation.within(Column(arrays.array(unknown), column.axes)):
        rest = evaluation.of(source.otherwise).over(column.axes).array(count)
    found, rest = one_type(found, rest)
    return Column(pc.if_else(arrays.array(unknown), rest, found), column.axes)


def _replaced(evaluation: Evaluation, field: Filled, column: Column, type_: DataType) -> Array:
    """Return the struct with the fields of `with` in place."""
    struct = column.values
    if not field.replaced:
        return struct
    children = [struct.field(i) for i in range(type_.num_fields)]
    for replaced in field.replaced:
        value = Column(fill(evaluation, replaced)).over(column.axes).array(0)
        children[type_.get_field_index(replaced.name)] = value
    return struct_of(children, type_, nulls(struct), len(struct))
