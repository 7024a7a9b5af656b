"""Explain an adapter: the source of each column, and the message fields it does not read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, TypeAlias

import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.adapters.adapter import Adapter, AdapterSpec
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
    FieldAccess,
    FunctionCall,
    MakeList,
    MessageRef,
    OpenList,
    TypedExpression,
)
from mosaico_ingest.adapters.mapping.loader import MappingAdapter, MappingSpec
from mosaico_ingest.adapters.mapping.model import Scalar, Value, ValueForm
from mosaico_ingest.adapters.mapping.types import format_type, is_list
from mosaico_ingest.adapters.python import PythonAdapterSpec, ontology_of
from mosaico_ingest.adapters.standalone import mapping_of
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.rosbag.definitions.model import normalize_msgtype

__all__ = [
    "ColumnOrigin",
    "Description",
    "describe",
    "unread_fields",
]

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


def _of_field(field: ColumnPlan, at: _Place) -> Iterator[_Place]:
    """Yield what a column reads, as seen from the message; `at` is where its names are looked up."""
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
            place = _place(source.operand, at)
            yield from _of_adapter(inner, place) if isinstance(inner, MappingAdapter) else (place,)
        case StructSource():
            inside = at if source.operand is None else _place(source.operand, at)
            for one in source.fields:
                yield from _of_field(one, inside)
        case _:
            pass
    for one in field.overrides:
        yield from _of_field(one, at)
    if field.when is not None:
        yield from _of_value(field.when, at)


def _of_value(typed: TypedExpression, at: _Place) -> Iterator[_Place]:
    match typed:
        case Constant():
            return
        case FunctionCall(arguments=parts) | MakeList(items=parts):
            pass
        case Conditional():
            parts = (typed.condition, typed.then, typed.otherwise)
        case Cast():
            parts = (typed.operand,)
        case _:
            yield _place(typed, at)
            if not isinstance(typed, MessageRef):
                yield from _computed_inside(typed, at)
            return
    for part in parts:
        yield from _of_value(part, at)


def _computed_inside(typed: FieldAccess | OpenList | CloseList | ElementAt, at: _Place) -> Iterator[_Place]:
    """Yield what is read under a list that is computed before it is opened, as `sorted(a)[0]`."""
    inner: Any = typed
    while isinstance(inner, (FieldAccess, OpenList, CloseList, ElementAt)):
        inner = inner.operand
    if not isinstance(inner, MessageRef):
        yield from _of_value(inner, at)


def _place(typed: TypedExpression, at: _Place) -> _Place:
    """Return the field an expression walks to; where it starts from something computed, that adds nothing."""
    match typed:
        case FieldAccess():
            return (*_place(typed.operand, at), typed.name)
        case OpenList() | CloseList() | ElementAt():
            return _place(typed.operand, at)
        case MessageRef():
            return at
        case _:
            return ("",)  # no field is called so


class ColumnOrigin(Struct, frozen=True):
    """One column of the records, or a field of one, and where its values come from."""

    name: str
    """As `orientation.covariance`; `poses[].header` is a field of a list's elements."""
    type: str
    required: bool
    origin: str | None
    """An expression, or a form in one line; None: it is null."""


class Description(Struct, frozen=True):
    """An adapter in words."""

    name: str
    summary: str
    default: bool
    """Whether it is used for its types without being asked for."""
    ontology: str
    serialization_format: str
    takes: Mapping[str, str]
    """Message type → where the payload sits in it; empty where it is the message itself."""
    columns: tuple[ColumnOrigin, ...]


def describe(spec: AdapterSpec, msgtype: str | None = None) -> Description:
    """Describe an adapter as it treats one of its types, or the first.

    Raises:
        AdapterError: Its ontology class is no such class.
    """
    mapping = mapping_of(spec)
    if mapping is not None:
        return _of_mapping(mapping, msgtype)
    if isinstance(spec, PythonAdapterSpec):
        return _of_class(spec)
    summary = "Keeps a message in its ROS shape, under the last part of its type's name"
    return Description(spec.name, summary, spec.default, "", "default", dict.fromkeys(spec.ros_types, ""), ())


def _of_mapping(spec: MappingSpec, msgtype: str | None) -> Description:
    variants = {normalize_msgtype(name): wrap for name, wrap in (spec.model.variants or {}).items()}
    wrap = variants.get(msgtype or spec.ros_types[0], {})
    values = {**spec.model.fields, **{name: value for name, value in wrap.items() if name != "of"}}
    return Description(
        spec.name,
        spec.model.description or "",
        spec.default,
        spec.ontology.tag,
        spec.ontology.serialization_format.value,
        {name: _text(variants.get(name, {}).get("of", "")) for name in spec.ros_types},
        tuple(_columns(spec.ontology.struct, values, "")),
    )


def _of_class(spec: PythonAdapterSpec) -> Description:
    cls: Any = spec.adapter
    ontology: OntologyType = ontology_of(cls.__mosaico_ontology_type__)
    method = "from_batch" if hasattr(cls, "from_batch") else "from_dict"
    origin = f"{cls.__module__}.{cls.__qualname__}.{method}"
    doc = (cls.__doc__ or "").strip().partition("\n")[0]
    columns = [
        ColumnOrigin(field.name, format_type(field.type), not field.nullable, origin)
        for field in ontology.struct
    ]
    takes = dict.fromkeys(spec.ros_types, "")
    layout = ontology.serialization_format.value
    return Description(spec.name, doc, spec.default, ontology.tag, layout, takes, tuple(columns))


def _columns(struct: DataType, values: Mapping[str, Value], prefix: str) -> Iterator[ColumnOrigin]:
    """Yield the fields of a struct in its order, those that are mappings of their own with their fields."""
    for field in struct:
        name = f"{prefix}{field.name}"
        value = values.get(field.name)
        origin = _origin(value) if isinstance(value, ValueForm) else None if value is None else _text(value)
        yield ColumnOrigin(name, format_type(field.type), not field.nullable, origin)
        if not isinstance(value, ValueForm):
            continue
        element, inner = field.type, f"{name}."
        while is_list(element):
            element, inner = element.value_type, f"{inner[:-1]}[]."
        if not pt.is_struct(element):
            continue
        if value.fields is not None:
            yield from _columns(element, {**value.fields, **(value.replaced or {})}, inner)
        elif value.replaced:
            named = [child for child in element if child.name in value.replaced]
            yield from _columns(named, value.replaced, inner)


def _origin(form: ValueForm) -> str:
    """Return a form in one line."""
    if form.use is not None:
        text = f"{form.use} of {form.of}"
    elif form.fields is not None:
        text = f"fields of {form.of}" if form.of else "field by field"
    else:
        text = _text(form.value)
    if form.map is not None:
        pairs = ", ".join(f"{_text(key)} → {_text(value)}" for key, value in form.map.items())
        text = f"{text}: {pairs}, else {_text(form.otherwise)}"
    return f"{text}, where {form.when}" if form.when else text


def _text(value: Value) -> str:
    """Return a plain value as the file spells it."""
    if isinstance(value, ValueForm):
        return _origin(value)
    words: dict[Scalar, str] = {None: "null", True: "true", False: "false"}
    return words[value] if value is None or isinstance(value, bool) else str(value)
