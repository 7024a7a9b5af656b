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
    EnvelopeField,
    FieldAccess,
    FunctionCall,
    MakeList,
    MessageRef,
    OpenList,
    OuterValue,
    TypedExpression,
)
from mosaico_ingest.adapters.mapping.loader import MappingAdapter, MappingSpec
from mosaico_ingest.adapters.mapping.model import Scalar, Value, ValueForm, records_of
from mosaico_ingest.adapters.mapping.types import format_type, is_list
from mosaico_ingest.adapters.python import PythonAdapterSpec, ontology_of
from mosaico_ingest.adapters.standalone import mapping_of
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.rosbag.definitions.model import normalize_msgtype

_FieldPath: TypeAlias = "tuple[str, ...]"
_ScopePaths: TypeAlias = "tuple[_FieldPath, ...]"
"""The paths of the messages around an expression, outermost first; names are looked up in the last one."""


def unread_fields(adapter: Adapter, shape: pa.StructType) -> tuple[str, ...]:
    """Return the fields that no expression reads, such as `header.seq`; () for an adapter in Python.

    A struct that is handed on whole counts as read.
    """
    if not isinstance(adapter, MappingAdapter):
        return ()
    read = set(_of_adapter(adapter, ()))
    return tuple(".".join(path) for path in _outside(shape, (), read))


def _outside(shape: DataType, at: _FieldPath, read: set[_FieldPath]) -> Iterator[_FieldPath]:
    for field in shape:
        path = (*at, field.name)
        if any(path[:length] in read for length in range(len(path) + 1)):
            continue
        element = field.type
        while is_list(element):
            element = element.value_type
        if pt.is_struct(element) and any(path_read[: len(path)] == path for path_read in read):
            yield from _outside(element, path, read)
        else:
            yield path


def _of_adapter(adapter: MappingAdapter, at: _FieldPath) -> Iterator[_FieldPath]:
    for output in (adapter, *adapter.others):
        yield from _of_field(output.record, (at,))
        for typed in (*output.drops, *output.metadata.values()):
            yield from _of_value(typed, (at,))


def _of_field(field: ColumnPlan, at: _ScopePaths) -> Iterator[_FieldPath]:
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
            yield from _of_adapter(inner, path) if isinstance(inner, MappingAdapter) else (path,)
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


def _of_value(typed: TypedExpression, at: _ScopePaths) -> Iterator[_FieldPath]:
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


def _computed_inside(typed: TypedExpression, at: _ScopePaths) -> Iterator[_FieldPath]:
    """Yield the fields below a computed list, as in `sort(a)[0]`."""
    inner: Any = typed
    while isinstance(inner, (FieldAccess, OpenList, CloseList, ElementAt)):
        inner = inner.operand
    if not isinstance(inner, MessageRef):
        yield from _of_value(inner, at)


def _path_of(typed: TypedExpression, at: _ScopePaths) -> _FieldPath:
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


class ColumnOrigin(Struct, frozen=True):
    """One column of the records, or a nested field, and the source of its values."""

    name: str
    """The path, such as `orientation.covariance`; `poses[].header` is a field of the elements of a list."""
    type: str
    required: bool
    origin: str | None
    """An expression or a form in one line; None if the column is null."""


class Description(Struct, frozen=True):
    """The description of an adapter."""

    name: str
    summary: str
    default: bool
    """Whether the adapter applies to its types without an override."""
    ontology: str
    serialization_format: str
    takes: Mapping[str, str]
    """Message type → path of the payload in it; empty if the payload is the message."""
    columns: tuple[ColumnOrigin, ...]


def describe(spec: AdapterSpec, msgtype: str | None = None) -> Description:
    """Describe an adapter for one of its types, by default the first.

    Raises:
        AdapterError: The adapter's ontology class is invalid.
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
    takes = {name: _text(variants.get(name, {}).get("of", "")) for name in spec.ros_types}
    outputs = spec.outputs or (spec,)
    columns: list[ColumnOrigin] = []
    for output, record in zip(outputs, records_of(spec.model).values(), strict=False):
        values = {**record.fields, **{name: value for name, value in wrap.items() if name != "of"}}
        prefix = f"{output.output}: " if output.output else ""
        columns += _columns(output.ontology.struct, values, prefix)
    return Description(
        spec.name,
        spec.model.description or "",
        spec.default,
        ", ".join(output.ontology.tag for output in outputs),
        spec.ontology.serialization_format.value,
        takes,
        tuple(columns),
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
    """Yield the fields of a struct in order, followed by their nested fields."""
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
    """Return a plain value as text of the file."""
    if isinstance(value, ValueForm):
        return _origin(value)
    words: dict[Scalar, str] = {None: "null", True: "true", False: "false"}
    return words[value] if value is None or isinstance(value, bool) else str(value)
