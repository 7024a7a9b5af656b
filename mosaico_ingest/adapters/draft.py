"""Draft an adapter file for a message type, and explain the columns of an adapter."""

from __future__ import annotations

import json
import keyword
import math
from collections.abc import Iterator, Mapping, Sequence
from textwrap import indent
from typing import Any, cast

import numpy as np
import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.adapters.adapter import Adapter, AdapterSpec, Envelope, short_name
from mosaico_ingest.adapters.builtin import BY_TYPE, find_builtin
from mosaico_ingest.adapters.mapping.columns import (
    DataType,
    TypeMismatch,
    expr_type_of,
    format_type,
    is_list,
    is_number,
    pt,
)
from mosaico_ingest.adapters.mapping.conversion import check_fits
from mosaico_ingest.adapters.mapping.loader import (
    MappingAdapter,
    MappingSpec,
    column_reads,
    load_adapter,
    metadata_reads,
    unread_paths,
)
from mosaico_ingest.adapters.mapping.model import Scalar, Value, ValueForm, records_of
from mosaico_ingest.adapters.python import PythonAdapterSpec, ontology_of
from mosaico_ingest.adapters.standalone import mapping_of
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.job.yaml_source import resolve_plain
from mosaico_ingest.ontology.registry import OntologyType, ontology_type, tags
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Container, Definition, Field, Language, normalize_msgtype

_RESERVED = frozenset({"self", "nan", "inf", "pi", "true", "false", "null"})
"""Names with another meaning in expressions."""
_TELLING = 4
"""Minimum length of a column name that is searched for within field names."""
_LONG = 1500
"""Maximum number of characters of a message in a test; longer messages are referenced in their recording."""


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


def unread_fields(adapter: Adapter, shape: pa.StructType) -> tuple[str, ...]:
    """Return the fields that no expression reads, such as `header.seq`; () for an adapter in Python.

    A struct that is handed on whole counts as read.
    """
    if not isinstance(adapter, MappingAdapter):
        return ()
    reads = {*column_reads(adapter), *metadata_reads(adapter)}
    return tuple(".".join(path) for path in unread_paths(shape, reads))


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


def quote_key(name: str) -> str:
    """Return a key of a YAML mapping, quoted if it would not be read as text."""
    return name if name.isidentifier() and resolve_plain(name) == (name, None) else json.dumps(name)


def quote_expression(text: str) -> str:
    """Return an expression, quoted if YAML would not read it as text."""
    return text if resolve_plain(text) == (text, None) else json.dumps(text)


def flow_style(value: Any) -> str:  # noqa: ANN401 - whatever a message holds
    """Return a value in YAML's flow style; bytes become a list of numbers."""
    if isinstance(value, Mapping):
        return (
            "{"
            + ", ".join(f"{quote_key(str(name))}: {flow_style(item)}" for name, item in value.items())
            + "}"
        )
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=True)
    if isinstance(value, Sequence):  # bytes too
        return "[" + ", ".join(flow_style(item) for item in value) + "]"
    if isinstance(value, float):
        return _number(value)
    return json.dumps(value)


def _number(value: float) -> str:
    if math.isnan(value):
        return ".nan"
    if math.isinf(value):
        return ".inf" if value > 0 else "-.inf"
    return repr(value)


class ColumnDraft(Struct, frozen=True):
    """The proposed value of a column."""

    name: str
    value: str | None
    """The value as text of the file; for a struct with `fields`, its `of`. None leaves the column null."""
    note: str = ""
    """A comment: the column's type, and why the value was chosen."""
    fields: tuple[ColumnDraft, ...] = ()


class _Candidate(Struct, frozen=True):
    """A field of the message, also a nested one, but not inside a list."""

    path: tuple[str, ...]
    type: DataType
    msgtype: str | None
    """The message type of a message, or of a list of messages."""
    is_repeated: bool

    @property
    def text(self) -> str:
        return _expression(*self.path)


def draft_columns(struct: DataType, definition: Definition, shape: pa.StructType) -> tuple[ColumnDraft, ...]:
    """Return a proposal for every column of an ontology type; required columns always get a value."""
    candidates = sorted(
        _candidates(definition, definition.root, shape, ()), key=lambda candidate: len(candidate.path)
    )
    return tuple(_column(field, candidates) for field in struct)


def _column(field: DataType, candidates: Sequence[_Candidate]) -> ColumnDraft:
    type_ = format_type(field.type)
    for group in _by_likeness(field, candidates):
        values = [value for candidate in group if (value := _fitting(candidate, field.type)) is not None]
        if len(values) == 1:
            return ColumnDraft(
                field.name, values[0], f"{type_}, {'may be null' if field.nullable else 'required'}"
            )
    similar = ", ".join(
        candidate.text
        for candidate in candidates
        if len(candidate.path) == 1 and _resembles(field.name, candidate.path[0])
    )
    note = f"{type_}, perhaps {similar}" if similar else type_
    if field.nullable:
        return ColumnDraft(field.name, None, note)
    if pt.is_struct(field.type):
        inner = tuple(_column(child, ()) for child in field.type)
        return ColumnDraft(field.name, None, "required: no field has this name", inner)
    return ColumnDraft(field.name, _placeholder(field.type), f"{note}, required: no field has this name")


def _by_likeness(field: DataType, candidates: Sequence[_Candidate]) -> Iterator[list[_Candidate]]:
    """Yield groups of candidate fields, best match first. A group with several fitting fields is ambiguous."""
    namesakes = [
        candidate for candidate in candidates if _normalized(candidate.path[-1]) == _normalized(field.name)
    ]
    yield [candidate for candidate in namesakes if len(candidate.path) == 1]
    yield namesakes
    if pt.is_struct(field.type):
        yield [
            candidate
            for candidate in candidates
            if candidate.msgtype is not None and _resembles(field.name, candidate.path[-1])
        ]
        if not field.nullable:
            yield [
                candidate
                for candidate in candidates
                if candidate.msgtype is not None and len(candidate.path) == 1
            ]


def _resembles(column: str, name: str) -> bool:
    return len(column) >= _TELLING and _normalized(column) in _normalized(name)


def _candidates(
    definition: Definition, msgtype: str, shape: DataType, at: tuple[str, ...]
) -> Iterator[_Candidate]:
    for field in definition.types[msgtype].fields:
        path, type_ = (*at, field.name), shape.field(shape.get_field_index(field.name)).type
        message = field.type if field.is_message else None
        yield _Candidate(path, type_, message, field.container is not Container.SCALAR)
        if field.is_message and field.container is Container.SCALAR:
            yield from _candidates(definition, field.type, type_, path)


def _fitting(candidate: _Candidate, target: DataType) -> str | None:
    """Return the simplest expression of a candidate that fits a column, None if there is none."""
    if _fits(candidate.type, target, candidate.msgtype):
        return candidate.text
    if is_number(candidate.type) and is_number(target):
        return f"cast({candidate.text})"
    nested = _adapted(candidate.msgtype, is_repeated=candidate.is_repeated)
    if nested is None:
        return None
    adapter, columns = nested
    return (
        _by_adapter(adapter, candidate.text, is_repeated=candidate.is_repeated)
        if _fits(columns, target)
        else None
    )


def _by_adapter(adapter: str, text: str, *, is_repeated: bool) -> str:
    return f'{{use: {adapter}, of: "{text}{"[]" if is_repeated else ""}"}}'


def _expression(first: str, *rest: str) -> str:
    """Return the expression that reads a field."""
    odd = keyword.iskeyword(first) or first in _RESERVED
    names = "".join(f"['{name}']" if keyword.iskeyword(name) else f".{name}" for name in rest)
    return (f"self['{first}']" if odd else first) + names


def _fits(source: DataType, target: DataType, msgtype: str | None = None) -> bool:
    try:
        check_fits(expr_type_of(source, msgtype=msgtype), target)
    except TypeMismatch:
        return False
    return True


def _adapted(msgtype: str | None, *, is_repeated: bool) -> tuple[str, DataType] | None:
    """Return the built-in adapter of a nested message and the type of its records."""
    builtin = BY_TYPE.get(msgtype or "")
    if builtin is None:
        return None
    struct = ontology_type(builtin.tag).struct
    return builtin.name, pa.list_(struct) if is_repeated else struct


def _placeholder(type_: DataType) -> str:
    """Return a placeholder that fits a required column."""
    return f'"{text}"' if (text := _zero(type_))[:1] in {"[", "'", "b"} else text


def _zero(type_: DataType) -> str:
    if pt.is_binary(type_):
        return "bytes([cast(0, 'uint8')])"
    if pt.is_string(type_):
        return "''"
    if pt.is_boolean(type_):
        return "false"
    if pt.is_fixed_size_list(type_):
        return f"[{', '.join([_zero(type_.value_type)] * type_.list_size)}]"
    return "[]" if pt.is_list(type_) else "0"


def _normalized(name: str) -> str:
    return name.replace("_", "").lower()


def draft_ontology_type(definition: Definition) -> tuple[list[str], tuple[ColumnDraft, ...]]:
    """Return the YAML lines of an ontology type that mirrors a message, and the value of each of its fields."""
    columns = _mirrored_fields(definition, definition.root, ros_shape(definition), "    ", top=True)
    return [line for lines, _ in columns for line in lines], tuple(
        column_draft for _, group in columns for column_draft in group
    )


_Columns = tuple[list[str], list[ColumnDraft]]


def _mirrored_fields(
    definition: Definition, msgtype: str, shape: DataType, margin: str, *, top: bool = False
) -> list[_Columns]:
    columns: list[_Columns] = []
    for field in definition.types[msgtype].fields:
        # The envelope has the column `timestamp_ns`.
        name = f"{field.name}_" if top and field.name == "timestamp_ns" else field.name
        type_ = shape.field(shape.get_field_index(field.name)).type
        columns.append(_mirrored_field(definition, field, name, type_, margin))
    return columns


def _mirrored_field(
    definition: Definition, field: Field, name: str, type_: DataType, margin: str
) -> _Columns:
    """Return the columns for one field of the message."""
    is_repeated, text = field.container is not Container.SCALAR, _expression(field.name)
    if not field.is_message:
        return [f"{margin}{quote_key(name)}: {format_type(type_)}"], [
            ColumnDraft(name, quote_expression(text))
        ]
    nested = _adapted(field.type, is_repeated=is_repeated)
    if nested is not None:
        tag = BY_TYPE[field.type].tag
        own = (
            quote_expression(text)
            if tag == "Header" and not is_repeated
            else _by_adapter(nested[0], text, is_repeated=is_repeated)
        )
        return [f"{margin}{quote_key(name)}: {f'list[{tag}]' if is_repeated else tag}"], [
            ColumnDraft(name, own)
        ]
    inner = _mirrored_fields(definition, field.type, _element(type_), margin + "    ")
    lines = [line for part, _ in inner for line in part]
    drafts = tuple(column_draft for _, part in inner for column_draft in part)
    if not lines:
        return [], []
    head = [f"{margin}{quote_key(name)}:", *([f"{margin}  type: list"] if is_repeated else [])]
    of = quote_expression(f"{text}[]" if is_repeated else text)
    return [*head, f"{margin}  fields:", *lines], [ColumnDraft(name, of, fields=drafts)]


def _element(type_: DataType) -> DataType:
    """Return the type of the elements of a list, any other type unchanged."""
    return type_.value_type if is_list(type_) else type_


class RecordedExample(Struct, frozen=True):
    """A recorded message for the test of a draft."""

    row: pa.StructArray
    """The message in the ROS shape, as the only row."""
    location: Mapping[str, Any]
    """Its location: bag, topic, index."""


def draft(
    definition: Definition,
    *,
    ontology: str | None = None,
    embed: bool = False,
    example: RecordedExample | None = None,
) -> str:
    """Return an adapter file that binds to a message type without changes.

    Without `ontology`, the file declares a type of its own. `embed` adds the definition, for a type that no distro has.

    Raises:
        AdapterError: The message type has no fields, or the ontology does not exist.
    """
    shape = ros_shape(definition)
    if not definition.message.fields:
        raise AdapterError(f"{definition.root} has no fields", hint="choose a type with fields")
    if ontology is None:
        own, drafts = draft_ontology_type(definition)
        target = "\n".join(["ontology:", f"  tag: {_tag(definition)}", "  fields:", *own])
    else:
        drafts = draft_columns(ontology_type(ontology).struct, definition, shape)
        target = f"ontology: {ontology}"
    lines = list(_lines(drafts, "  "))
    head = [*_head(definition), target, "", _opening(lines), *lines]
    spec = load_adapter("\n".join(head) + "\n", file="<draft>", adapters=find_builtin)
    adapter = spec.bind(definition, shape)
    parts = ["\n".join([*head, *_unread(adapter, definition, shape)])]
    is_ros = definition.language is Language.ROS
    if embed and is_ros:
        parts.append("definition: |\n" + indent(definition.text.rstrip("\n"), "  ", lambda _: True))
    # A file can only contain `.msg` texts, without which `given: {}` has no type.
    if is_ros or example is not None:
        parts.append("tests:\n" + "\n".join(_test(spec, adapter, definition, example)))
    return "\n\n".join(parts) + "\n"


def _tag(definition: Definition) -> str:
    """Return a tag that no built-in ontology type has."""
    short = short_name(definition.root)
    return f"{short}Message" if short in tags() else short


def _head(definition: Definition) -> Iterator[str]:
    yield "# yaml-language-server: $schema=adapter.schema.json"
    yield "# `ingest schema adapter --write .` writes that schema, for completion and hover in an editor."
    yield f"# A draft for {definition.root}: fields with matching names are mapped; complete the rest."
    constants = ", ".join(f"{one.name} = {one.value}" for one in definition.message.constants)
    if constants:
        yield f"# Constants of the message, usable by name: {constants}"
    yield "version: 1"
    yield f"adapter: {short_name(definition.root)}Adapter"
    yield f"ros_type: {definition.root}"


def _lines(drafts: tuple[ColumnDraft, ...], margin: str) -> Iterator[str]:
    for column_draft in drafts:
        note = f"  # {column_draft.note}" if column_draft.note else ""
        if column_draft.fields:
            of = f"of: {column_draft.value}" if column_draft.value else None
            yield f"{margin}{quote_key(column_draft.name)}:{note}"
            if of:
                yield f"{margin}  {of}"
            inner = list(_lines(column_draft.fields, margin + "    "))
            yield f"{margin}  {_opening(inner)}"
            yield from inner
        elif column_draft.value is None:
            yield f"{margin}# {quote_key(column_draft.name)}:{note}"
        else:
            yield f"{margin}{quote_key(column_draft.name)}: {column_draft.value}{note}"


def _opening(lines: list[str]) -> str:
    """Return the line above the fields; YAML needs an explicit empty mapping if all fields are comments."""
    return "fields: {}" if all(line.lstrip().startswith("#") for line in lines) else "fields:"


def _unread(adapter: MappingAdapter, definition: Definition, shape: pa.StructType) -> Iterator[str]:
    names = unread_fields(adapter, shape)
    if names:
        yield f"  # Not used yet, of {definition.root}: {', '.join(names)}"


def _test(
    spec: MappingSpec, adapter: MappingAdapter, definition: Definition, example: RecordedExample | None
) -> Iterator[str]:
    if example is None:
        yield "  - name: all fields zero"
        yield "    given: {}"
        yield "    expect: {}"
        return
    adapted = adapter.adapt(example.row, Envelope("", definition.root, np.zeros(1, np.int64)))
    message = flow_style(_without_defaults(cast("Any", example.row)[0].as_py()))
    yield f"  - name: a message of {example.location['topic']}"
    is_short = len(message) <= _LONG and definition.language is Language.ROS
    yield f"    given: {message if is_short else flow_style(example.location)}"
    if adapted.failures:
        yield f"    # {spec.name} rejects it: {adapted.failures[0].reason}"
        yield f"    rejects: {flow_style(adapted.failures[0].reason)}"
        return
    expected = {
        name: flow_style(value)
        for name, value in _without_nulls(cast("Any", adapted.rows)[0].as_py()).items()
    }
    short = {name: text for name, text in expected.items() if len(text) <= _LONG}
    yield "    expect:" if short else "    expect: {}"
    for name, text in short.items():
        yield f"      {quote_key(name)}: {text}"


def _without_defaults(message: dict[str, Any]) -> dict[str, Any]:
    """Return a message without zeros, empty texts and empty lists, which are the defaults of a test."""
    values = {
        name: _without_defaults(cast("Any", value)) if isinstance(value, dict) else value
        for name, value in message.items()
    }
    return {
        name: value
        for name, value in values.items()
        if value is not None and value not in (0, "", b"", [], {})
    }


def _without_nulls(record: dict[str, Any]) -> dict[str, Any]:
    """Return a record without nulls."""
    values = {
        name: _without_nulls(cast("Any", value)) if isinstance(value, dict) else value
        for name, value in record.items()
    }
    return {name: value for name, value in values.items() if value is not None and value != {}}
