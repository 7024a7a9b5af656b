"""Draft an adapter file for a message type by matching field names."""

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

from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.builtin import BY_TYPE, find_builtin
from mosaico_ingest.adapters.explain import unread_fields
from mosaico_ingest.adapters.mapping.columns import DataType, pt
from mosaico_ingest.adapters.mapping.conversion import check_fits
from mosaico_ingest.adapters.mapping.loader import MappingAdapter, MappingSpec, load_adapter
from mosaico_ingest.adapters.mapping.types import (
    TypeMismatch,
    expr_type_of,
    format_type,
    is_number,
)
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.job.yaml_source import resolve_plain
from mosaico_ingest.ontology.registry import ontology_type, tags
from mosaico_ingest.rosbag.definitions.linking import TEXTS, ros_shape
from mosaico_ingest.rosbag.definitions.model import Container, Definition, Field
from mosaico_ingest.rosbag.definitions.parser import BYTES

__all__ = [
    "ColumnDraft",
    "RecordedExample",
    "draft",
    "draft_columns",
    "draft_ontology_type",
    "flow_style",
    "quote_expression",
    "quote_key",
]


def quote_key(name: str) -> str:
    """Return a mapping's key, quoted where it would not be read as text."""
    return name if name.isidentifier() and resolve_plain(name) == (name, None) else json.dumps(name)


def quote_expression(text: str) -> str:
    """Return an expression, quoted where it would not be read as text."""
    return text if resolve_plain(text) == (text, None) else json.dumps(text)


def flow_style(value: Any) -> str:  # noqa: ANN401 - whatever a message holds
    """Return a value in flow style; bytes become a list of numbers."""
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


_RESERVED = frozenset({"self", "nan", "inf", "pi", "true", "false", "null"})
"""What means something else in an expression."""
_TELLING = 4
"""From how many letters on a column's name is looked for inside longer ones."""


class ColumnDraft(Struct, frozen=True):
    """What may fill a column."""

    name: str
    value: str | None
    """As the file spells it, the `of` of one with fields; None: nothing is known, the column stays null."""
    note: str = ""
    """What a reader should know: the column's type, and what was taken for it."""
    fields: tuple[ColumnDraft, ...] = ()


class _Candidate(Struct, frozen=True):
    """A field of the message, however deep, but not inside a list."""

    path: tuple[str, ...]
    type: DataType
    msgtype: str | None
    """Where it is a message, or a list of them: which."""
    listed: bool

    @property
    def text(self) -> str:
        return _expression(*self.path)


def draft_columns(struct: DataType, definition: Definition, shape: pa.StructType) -> tuple[ColumnDraft, ...]:
    """Return a guess for every column of an ontology type; one that is required gets some value."""
    known = sorted(_candidates(definition, definition.root, shape, ()), key=lambda one: len(one.path))
    return tuple(_column(field, known) for field in struct)


def _column(field: DataType, known: Sequence[_Candidate]) -> ColumnDraft:
    type_ = format_type(field.type)
    for some in _by_likeness(field, known):
        values = [value for one in some if (value := _fitting(one, field.type)) is not None]
        if len(values) == 1:
            return ColumnDraft(
                field.name, values[0], f"{type_}, {'may be null' if field.nullable else 'required'}"
            )
    perhaps = ", ".join(
        one.text for one in known if len(one.path) == 1 and _resembles(field.name, one.path[0])
    )
    note = f"{type_}, perhaps {perhaps}" if perhaps else type_
    if field.nullable:
        return ColumnDraft(field.name, None, note)
    if pt.is_struct(field.type):
        inner = tuple(_column(child, ()) for child in field.type)
        return ColumnDraft(field.name, None, "required: no field is called so", inner)
    return ColumnDraft(field.name, _nothing(field.type), f"{note}, required: no field is called so")


def _by_likeness(field: DataType, known: Sequence[_Candidate]) -> Iterator[list[_Candidate]]:
    """Yield fields that may be meant, the likeliest first; of several at once none is taken."""
    named = [one for one in known if _plain(one.path[-1]) == _plain(field.name)]
    yield [one for one in named if len(one.path) == 1]
    yield named
    if pt.is_struct(field.type):
        yield [one for one in known if one.msgtype is not None and _resembles(field.name, one.path[-1])]
        if not field.nullable:
            yield [one for one in known if one.msgtype is not None and len(one.path) == 1]


def _resembles(column: str, name: str) -> bool:
    return len(column) >= _TELLING and _plain(column) in _plain(name)


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
    """Return an expression of a candidate that fits a column, the plainest first."""
    if _fits(candidate.type, target, candidate.msgtype):
        return candidate.text
    if is_number(candidate.type) and is_number(target):
        return f"cast({candidate.text})"
    used = _adapted(candidate.msgtype, listed=candidate.listed)
    if used is None:
        return None
    adapter, made = used
    return _by_adapter(adapter, candidate.text, listed=candidate.listed) if _fits(made, target) else None


def _by_adapter(adapter: str, text: str, *, listed: bool) -> str:
    return f'{{use: {adapter}, of: "{text}{"[]" if listed else ""}"}}'


def _expression(first: str, *rest: str) -> str:
    """Return the way to a field, as expressions spell it."""
    odd = keyword.iskeyword(first) or first in _RESERVED
    names = "".join(f"['{name}']" if keyword.iskeyword(name) else f".{name}" for name in rest)
    return (f"self['{first}']" if odd else first) + names


def _fits(source: DataType, target: DataType, msgtype: str | None = None) -> bool:
    try:
        check_fits(expr_type_of(source, msgtype=msgtype), target)
    except TypeMismatch:
        return False
    return True


def _adapted(msgtype: str | None, *, listed: bool) -> tuple[str, DataType] | None:
    """Return the built-in adapter of a nested message and what it makes of it."""
    builtin = BY_TYPE.get(msgtype or "")
    if builtin is None:
        return None
    struct = ontology_type(builtin.tag).struct
    return builtin.name, pa.list_(struct) if listed else struct


def _nothing(type_: DataType) -> str:
    """Return a value that fits a required column and means nothing."""
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


def _plain(name: str) -> str:
    return name.replace("_", "").lower()


def draft_ontology_type(definition: Definition) -> tuple[list[str], tuple[ColumnDraft, ...]]:
    """Return the fields of an ontology type of one's own as lines of YAML, and what fills each."""
    made = _own_fields(definition, definition.root, ros_shape(definition), "    ", top=True)
    return [line for lines, _ in made for line in lines], tuple(guess for _, some in made for guess in some)


_Made = tuple[list[str], list[ColumnDraft]]


def _own_fields(
    definition: Definition, msgtype: str, shape: DataType, margin: str, *, top: bool = False
) -> list[_Made]:
    made: list[_Made] = []
    for field in definition.types[msgtype].fields:
        name = (
            f"{field.name}_" if top and field.name == "timestamp_ns" else field.name
        )  # the envelope's column
        type_ = shape.field(shape.get_field_index(field.name)).type
        made.append(_own(definition, field, name, type_, margin))
    return made


def _own(definition: Definition, field: Field, name: str, type_: DataType, margin: str) -> _Made:
    """Return what a field of the message becomes: a column like it, or some for a list of messages."""
    listed, text = field.container is not Container.SCALAR, _expression(field.name)
    if not field.is_message:
        return [f"{margin}{quote_key(name)}: {format_type(type_)}"], [
            ColumnDraft(name, quote_expression(text))
        ]
    used = _adapted(field.type, listed=listed)
    if used is not None:
        tag = BY_TYPE[field.type].tag
        own = (
            quote_expression(text)
            if tag == "Header" and not listed
            else _by_adapter(used[0], text, listed=listed)
        )
        return [f"{margin}{quote_key(name)}: {f'list[{tag}]' if listed else tag}"], [ColumnDraft(name, own)]
    if listed:
        return _spread(definition, field, margin)
    inner = _own_fields(definition, field.type, type_, margin + "    ")
    lines = [line for part, _ in inner for line in part]
    guesses = tuple(guess for _, part in inner for guess in part)
    if not lines:
        return [], []
    return [f"{margin}{quote_key(name)}:", f"{margin}  fields:", *lines], [
        ColumnDraft(name, quote_expression(text), fields=guesses)
    ]


def _spread(definition: Definition, field: Field, margin: str) -> _Made:
    """Return a list for each plain field of a list's messages; what nests deeper is left to the author."""
    made: _Made = ([], [])
    for child in definition.types[field.type].fields:
        if not child.is_message and child.container is Container.SCALAR:
            name = f"{field.name}_{child.name}"
            kind = "uint8" if child.type in BYTES else "string" if child.type in TEXTS else child.type
            made[0].append(f"{margin}{quote_key(name)}: list[{kind}]")
            made[1].append(ColumnDraft(name, f"{_expression(field.name)}[]{_expression('', child.name)}"))
    return made


_LONG = 1500
"""How many characters of a message a test spells out; a longer one is named by its place in the recording."""


class RecordedExample(Struct, frozen=True):
    """A recorded message for the draft's test."""

    row: pa.StructArray
    """The message as the only row, in the ROS shape."""
    place: Mapping[str, Any]
    """Where it is: bag, topic, index."""


def draft(
    definition: Definition,
    *,
    ontology: str | None = None,
    embed: bool = False,
    example: RecordedExample | None = None,
) -> str:
    """Return an adapter file for a message type that binds to it as it is.

    Without `ontology` it defines a type of its own. `embed` puts the definition in, for a type no distro knows.

    Raises:
        AdapterError: The message type has no fields, or there is no such ontology.
    """
    shape = ros_shape(definition)
    if not definition.message.fields:
        raise AdapterError(f"{definition.root} has no fields", hint="there is nothing to adapt")
    if ontology is None:
        own, guesses = draft_ontology_type(definition)
        target = "\n".join(["ontology:", f"  tag: {_tag(definition)}", "  fields:", *own])
    else:
        guesses = draft_columns(ontology_type(ontology).struct, definition, shape)
        target = f"ontology: {ontology}"
    lines = list(_lines(guesses, "  "))
    head = [*_head(definition), target, "", _opening(lines), *lines]
    spec = load_adapter("\n".join(head) + "\n", file="<draft>", adapters=find_builtin)
    adapter = spec.bind(definition, shape)
    parts = ["\n".join([*head, *_unread(adapter, definition, shape)])]
    if embed:
        parts.append("definition: |\n" + indent(definition.text.rstrip("\n"), "  ", lambda _: True))
    parts.append("tests:\n" + "\n".join(_test(spec, adapter, definition, example)))
    return "\n\n".join(parts) + "\n"


def _tag(definition: Definition) -> str:
    """Return a tag for a type of one's own; those of the ontology are taken."""
    short = definition.root.rpartition("/")[2]
    return f"{short}Message" if short in tags() else short


def _head(definition: Definition) -> Iterator[str]:
    yield f"# A first draft for {definition.root}: what has an equal name is filled in, the rest is for you."
    constants = ", ".join(f"{one.name} = {one.value}" for one in definition.message.constants)
    if constants:
        yield f"# Constants of the message, usable by name: {constants}"
    yield "version: 1"
    yield f"adapter: {definition.root.rpartition('/')[2]}Adapter"
    yield f"ros_type: {definition.root}"


def _lines(guesses: tuple[ColumnDraft, ...], margin: str) -> Iterator[str]:
    for guess in guesses:
        note = f"  # {guess.note}" if guess.note else ""
        if guess.fields:
            of = f"of: {guess.value}" if guess.value else None
            yield f"{margin}{quote_key(guess.name)}:{note}"
            if of:
                yield f"{margin}  {of}"
            inner = list(_lines(guess.fields, margin + "    "))
            yield f"{margin}  {_opening(inner)}"
            yield from inner
        elif guess.value is None:
            yield f"{margin}# {quote_key(guess.name)}:{note}"
        else:
            yield f"{margin}{quote_key(guess.name)}: {guess.value}{note}"


def _opening(lines: list[str]) -> str:
    """Return what stands before fields: YAML needs an empty mapping where all of them are comments."""
    return "fields: {}" if all(line.lstrip().startswith("#") for line in lines) else "fields:"


def _unread(adapter: MappingAdapter, definition: Definition, shape: pa.StructType) -> Iterator[str]:
    names = unread_fields(adapter, shape)
    if names:
        yield f"  # Not used yet, of {definition.root}: {', '.join(names)}"


def _test(
    spec: MappingSpec, adapter: MappingAdapter, definition: Definition, example: RecordedExample | None
) -> Iterator[str]:
    if example is None:
        yield "  - name: nothing but zeros"
        yield "    given: {}"
        yield "    expect: {}"
        return
    adapted = adapter.adapt(example.row, Envelope("", definition.root, np.zeros(1, np.int64)))
    given = flow_style(_said(cast("Any", example.row)[0].as_py()))
    yield f"  - name: a message of {example.place['topic']}"
    yield f"    given: {given if len(given) <= _LONG else flow_style(example.place)}"
    if adapted.failures:
        yield f"    # {spec.name} rejects it: {adapted.failures[0].reason}"
        yield f"    rejects: {flow_style(adapted.failures[0].reason)}"
        return
    expected = {
        name: flow_style(value) for name, value in _known(cast("Any", adapted.rows)[0].as_py()).items()
    }
    short = {name: text for name, text in expected.items() if len(text) <= _LONG}
    yield "    expect:" if short else "    expect: {}"
    for name, text in short.items():
        yield f"      {quote_key(name)}: {text}"


def _said(message: dict[str, Any]) -> dict[str, Any]:
    """Return a message without what a test need not give: zeros, empty texts and lists."""
    kept = {
        name: _said(cast("Any", value)) if isinstance(value, dict) else value
        for name, value in message.items()
    }
    return {
        name: value for name, value in kept.items() if value is not None and value not in (0, "", b"", [], {})
    }


def _known(record: dict[str, Any]) -> dict[str, Any]:
    """Return a record without its nulls."""
    kept = {
        name: _known(cast("Any", value)) if isinstance(value, dict) else value
        for name, value in record.items()
    }
    return {name: value for name, value in kept.items() if value is not None and value != {}}
