"""This file derives the Arrow columns of a model from its annotated fields."""

from __future__ import annotations

import types
from collections.abc import Iterable, Sequence
from enum import Enum
from functools import cache
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import pyarrow as pa
from pydantic import BaseModel

from mosaico_ingest.errors import AdapterError
from mosaico_ingest.frozen import frozen
from mosaico_ingest.ontology.fields import FixedSize, Nullable

__all__ = ["struct_of"]

_PLAIN: dict[type, pa.DataType] = {
    bool: pa.bool_(),  # before int, which it is a subclass of
    int: pa.int64(),
    float: pa.float64(),
    str: pa.string(),
    bytes: pa.binary(),
}


@cache
def struct_of(model: type[BaseModel]) -> pa.StructType:
    """Return the columns of `model`, in the order of its fields.

    Raises:
        AdapterError: A field's annotation has no Arrow type.
    """
    return _struct(model, ())


@frozen
class _Column:
    """An annotation taken apart: the bare type and what was said about it."""

    bare: Any
    nullable: bool
    exact: pa.DataType | None
    size: int


def _struct(model: type[BaseModel], outer: tuple[type[BaseModel], ...]) -> pa.StructType:
    if model in outer:
        raise AdapterError(
            "contains itself, which columns cannot", where=model.__name__, hint="refer to it by a key"
        )
    inside = (*outer, model)
    fields: list[pa.Field[Any]] = []
    for name, field in model.model_fields.items():
        column = _take_apart(field.annotation, field.metadata)
        data_type = _arrow(column, f"{model.__name__}.{name}", inside)
        fields.append(pa.field(name, data_type, nullable=column.nullable))
    return pa.struct(fields)


def _take_apart(annotation: Any, metadata: Iterable[object] = ()) -> _Column:  # noqa: ANN401 - any annotation
    marks = list(metadata)
    nullable = False
    while True:
        origin = get_origin(annotation)
        if origin is Annotated:
            annotation, *more = get_args(annotation)
            marks += more
        elif origin in (Union, types.UnionType) and type(None) in get_args(annotation):
            rest = tuple(arg for arg in get_args(annotation) if arg is not type(None))
            annotation, nullable = Union[rest], True  # noqa: UP007 - a tuple cannot be spelled with |
        else:
            break
    exact = next((mark for mark in marks if isinstance(mark, pa.DataType)), None)
    size = next((mark.length for mark in marks if isinstance(mark, FixedSize)), -1)
    nullable = nullable or any(mark is Nullable or isinstance(mark, Nullable) for mark in marks)
    return _Column(annotation, nullable, exact, size)


def _arrow(column: _Column, where: str, outer: tuple[type[BaseModel], ...]) -> pa.DataType:
    if column.exact is not None:
        return column.exact
    bare = column.bare
    if get_origin(bare) in (list, tuple, Sequence):
        return _list(column, where, outer)
    if get_origin(bare) is Literal:
        kinds = {type(value) for value in get_args(bare)}
        bare = kinds.pop() if len(kinds) == 1 else bare
    if isinstance(bare, type):
        if issubclass(bare, BaseModel):
            return _struct(bare, outer)
        plain = next((arrow for kind, arrow in _PLAIN.items() if issubclass(bare, kind)), None)
        if plain is not None and (bare in _PLAIN or issubclass(bare, Enum)):
            return plain
    raise AdapterError(
        f"the annotation {_spell(bare)} has no column type",
        where=where,
        hint="use bool, int, float, str, bytes, a list, a nested model, or Annotated[…, <an Arrow type>]",
    )


def _list(column: _Column, where: str, outer: tuple[type[BaseModel], ...]) -> pa.DataType:
    items = [arg for arg in get_args(column.bare) if arg is not ...]
    if len(items) != 1:
        raise AdapterError(
            f"the annotation {_spell(column.bare)} mixes item types", where=where, hint="use a nested model"
        )
    item = pa.field("item", _arrow(_take_apart(items[0]), f"{where}[]", outer))
    return pa.list_(item, column.size)


def _spell(annotation: object) -> str:
    return annotation.__name__ if isinstance(annotation, type) else str(annotation)
