"""This file finds which fields of a message a mapping never looks at."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeAlias

import pyarrow as pa

from mosaico_ingest.adapters.adapter import Adapter
from mosaico_ingest.adapters.mapping.arrow import DataType, pt
from mosaico_ingest.adapters.mapping.build import ByAdapter, ByFields, Computed, Filled, Looked
from mosaico_ingest.adapters.mapping.kinds import is_list
from mosaico_ingest.adapters.mapping.load import MappingAdapter
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

__all__ = ["unread_fields"]

_Place: TypeAlias = "tuple[str, ...]"


def unread_fields(adapter: Adapter, shape: pa.StructType) -> tuple[str, ...]:
    """Return the fields no expression names, as `header.seq`; none of an adapter that is no mapping.

    A struct that is handed on whole counts as read.
    """
    if not isinstance(adapter, MappingAdapter):
        return ()
    read = set(_of_adapter(adapter, ()))
    return tuple(".".join(place) for place in _outside(shape, (), read))


def _outside(shape: DataType, at: _Place, read: set[_Place]) -> Iterator[_Place]:
    for field in shape:
        place = (*at, field.name)
        if any(place[:length] in read for length in range(len(place) + 1)):
            continue
        element = field.type
        while is_list(element):
            element = element.value_type
        if pt.is_struct(element) and any(known[: len(place)] == place for known in read):
            yield from _outside(element, place, read)
        else:
            yield place


def _of_adapter(adapter: MappingAdapter, at: _Place) -> Iterator[_Place]:
    yield from _of_field(adapter.record, at)
    for typed in adapter.metadata.values():
        yield from _of_value(typed, at)


def _of_field(field: Filled, at: _Place) -> Iterator[_Place]:
    """Yield what a column reads, as seen from the message; `at` is where its names are looked up."""
    source = field.source
    match source:
        case Computed():
            yield from _of_value(source.typed, at)
        case Looked():
            yield from _of_value(source.typed, at)
            if source.otherwise is not None:
                yield from _of_value(source.otherwise, at)
        case ByAdapter():
            inner = source.adapter
            place = _place(source.of, at)
            yield from _of_adapter(inner, place) if isinstance(inner, MappingAdapter) else (place,)
        case ByFields():
            inside = at if source.of is None else _place(source.of, at)
            for one in source.fields:
                yield from _of_field(one, inside)
        case _:
            pass
    for one in field.replaced:
        yield from _of_field(one, at)
    if field.when is not None:
        yield from _of_value(field.when, at)


def _of_value(typed: Typed, at: _Place) -> Iterator[_Place]:
    match typed:
        case Const():
            return
        case Apply(arguments=parts) | ListValue(items=parts):
            pass
        case ChoiceOf():
            parts = (typed.condition, typed.then, typed.otherwise)
        case Cast():
            parts = (typed.of,)
        case _:
            yield _place(typed, at)
            if not isinstance(typed, Whole):
                yield from _computed_inside(typed, at)
            return
    for part in parts:
        yield from _of_value(part, at)


def _computed_inside(typed: FieldOf | EachOf | Fold | ItemOf, at: _Place) -> Iterator[_Place]:
    """Yield what is read under a list that is computed before it is opened, as `sorted(a)[0]`."""
    inner: Any = typed
    while isinstance(inner, (FieldOf, EachOf, Fold, ItemOf)):
        inner = inner.of
    if not isinstance(inner, Whole):
        yield from _of_value(inner, at)


def _place(typed: Typed, at: _Place) -> _Place:
    """Return the field an expression walks to; where it starts from something computed, that adds nothing."""
    match typed:
        case FieldOf():
            return (*_place(typed.of, at), typed.name)
        case EachOf() | Fold() | ItemOf():
            return _place(typed.of, at)
        case Whole():
            return at
        case _:
            return ("",)  # no field is called so
