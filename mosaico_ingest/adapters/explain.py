"""Explain an adapter: the source of each column, and the message fields it does not read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.adapters.adapter import Adapter, AdapterSpec
from mosaico_ingest.adapters.mapping.columns import DataType, pt
from mosaico_ingest.adapters.mapping.loader import MappingAdapter, MappingSpec
from mosaico_ingest.adapters.mapping.model import Scalar, Value, ValueForm, records_of
from mosaico_ingest.adapters.mapping.reads import column_reads, metadata_reads, unread_paths
from mosaico_ingest.adapters.mapping.types import format_type, is_list
from mosaico_ingest.adapters.python import PythonAdapterSpec, ontology_of
from mosaico_ingest.adapters.standalone import mapping_of
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.rosbag.definitions.model import normalize_msgtype


def unread_fields(adapter: Adapter, shape: pa.StructType) -> tuple[str, ...]:
    """Return the fields that no expression reads, such as `header.seq`; () for an adapter in Python.

    A struct that is handed on whole counts as read.
    """
    if not isinstance(adapter, MappingAdapter):
        return ()
    reads = {*column_reads(adapter), *metadata_reads(adapter)}
    return tuple(".".join(path) for path in unread_paths(shape, reads))


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
            replacements = [child for child in element if child.name in value.replaced]
            yield from _columns(replacements, value.replaced, inner)


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
