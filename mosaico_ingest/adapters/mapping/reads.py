"""The message fields that a compiled mapping reads."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeAlias

from mosaico_ingest.adapters.mapping.column_plan import (
    ColumnPlan,
    ExpressionSource,
    MapLookup,
    NestedAdapter,
    StructSource,
)
from mosaico_ingest.adapters.mapping.columns import DataType, pt
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
from mosaico_ingest.adapters.mapping.loader import MappingAdapter
from mosaico_ingest.adapters.mapping.types import is_list

ReadPath: TypeAlias = "tuple[str, ...]"
"""The names that lead to a field, without marks for lists: `joints`, `name` for `joints[].name`."""
_Scopes: TypeAlias = "tuple[ReadPath, ...]"
"""The paths of the messages around an expression, outermost first; names are looked up in the last one."""


def unread_paths(shape: DataType, reads: set[ReadPath], at: ReadPath = ()) -> Iterator[ReadPath]:
    """Yield the fields of a message that are not among the fields read; a struct of unread fields is one field."""
    for field in shape:
        path = (*at, field.name)
        if any(path[:length] in reads for length in range(len(path) + 1)):
            continue
        element = field.type
        while is_list(element):
            element = element.value_type
        if pt.is_struct(element) and any(path_read[: len(path)] == path for path_read in reads):
            yield from unread_paths(element, reads, path)
        else:
            yield path


def column_reads(adapter: MappingAdapter, at: ReadPath = ()) -> Iterator[ReadPath]:
    """Yield the fields that the columns and the conditions of an adapter read, as paths from the message."""
    for output in (adapter, *adapter.others):
        yield from _of_field(output.record, (at,))
        for typed in output.drops:
            yield from _of_value(typed, (at,))


def metadata_reads(adapter: MappingAdapter, at: ReadPath = ()) -> Iterator[ReadPath]:
    """Yield the fields that the topic metadata contains."""
    for output in (adapter, *adapter.others):
        for typed in output.metadata.values():
            yield from _of_value(typed, (at,))


def _of_field(field: ColumnPlan, at: _Scopes) -> Iterator[ReadPath]:
    """Yield the fields that a column reads, as paths from the message; `at` is the scope of its names."""
    source = field.source
    match source:
        case ExpressionSource():
            yield from _of_value(source.expression, at)
        case MapLookup():
            yield from _of_value(source.operand, at)
            if source.otherwise is not None:
                yield from _of_value(source.otherwise, at)
        case NestedAdapter():
            inner = source.adapter
            path = _path_of(source.operand, at)
            yield from column_reads(inner, path) if isinstance(inner, MappingAdapter) else (path,)
        case StructSource():
            inside = at if source.operand is None else (*at, _path_of(source.operand, at))
            if source.operand is not None:
                yield from _computed_inside(source.operand, at)
            for column in source.fields:
                yield from _of_field(column, inside)
        case _:
            pass
    for column in field.overrides:
        yield from _of_field(column, at)
    if field.when is not None:
        yield from _of_value(field.when, at)


def _of_value(typed: TypedExpression, at: _Scopes) -> Iterator[ReadPath]:
    match typed:
        case Constant() | EnvelopeField():
            return
        case OuterValue():
            yield from _of_value(typed.operand, at[: -typed.levels])
            return
        case FunctionCall(arguments=parts) | MakeList(items=parts):
            pass
        case Conditional():
            parts = (typed.condition, typed.then, typed.otherwise)
        case Cast():
            parts = (typed.operand,)
        case _:
            yield _path_of(typed, at)
            yield from _computed_inside(typed, at)
            return
    for part in parts:
        yield from _of_value(part, at)


def _computed_inside(typed: TypedExpression, at: _Scopes) -> Iterator[ReadPath]:
    """Yield the fields below a computed list, as in `sort(a)[0]`."""
    inner: Any = typed
    while isinstance(inner, (FieldAccess, OpenList, CloseList, ElementAt)):
        inner = inner.operand
    if not isinstance(inner, MessageRef):
        yield from _of_value(inner, at)


def _path_of(typed: TypedExpression, at: _Scopes) -> ReadPath:
    """Return the path of the field that an expression reads; computed values have the path of no field."""
    match typed:
        case FieldAccess():
            return (*_path_of(typed.operand, at), typed.name)
        case OpenList() | CloseList() | ElementAt():
            return _path_of(typed.operand, at)
        case MessageRef():
            return at[-1]
        case OuterValue():
            return _path_of(typed.operand, at[: -typed.levels])
        case _:
            return ("",)  # no field has an empty name
