"""This file writes the first draft of an adapter file: every field of a message type, ready to be cut down."""

from __future__ import annotations

import keyword
from collections.abc import Iterator

from mosaico_ingest.adapters.mapping.arrow import DataType, arrays, pt
from mosaico_ingest.adapters.mapping.fit import special
from mosaico_ingest.adapters.mapping.functions.ros import HEADER_TYPE
from mosaico_ingest.adapters.mapping.functions.time import STAMP_TYPE
from mosaico_ingest.adapters.mapping.kinds import is_list, listed, spell
from mosaico_ingest.bag.definition import Definition
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.ontology.tags import MODULES

__all__ = ["draft_adapter"]

_INDENT = "  "
_ENVELOPE = "timestamp_ns"
_YAML_WORDS = frozenset({"y", "n", "yes", "no", "on", "off", "true", "false", "null"})


def draft_adapter(definition: Definition, shape: DataType, *, name: str | None = None) -> str:
    """Return an adapter file (YAML) for a message type, with an ontology type of its own fields.

    Raises:
        AdapterError: The type has no fields.
    """
    short = definition.root.rsplit("/", 1)[-1]
    tag = f"{short}Message" if short in MODULES else short
    fields = [field for field in shape if _holds_something(field.type)]
    if not fields:
        raise AdapterError(f"{definition.root} has no fields", hint="there is nothing to adapt")
    lines = [
        "version: 1",
        f"adapter: {name or f'{short}Adapter'}",
        f"ros_type: {definition.root}",
        "ontology:",
        f"{_INDENT}tag: {tag}",
        f"{_INDENT}fields:",
        *(_INDENT * 2 + line for field in fields for line in _declared(_column(field.name), field.type)),
        "",
        "fields:",
        *(f"{_INDENT}{_column(field.name)}: {_expression(field.name)}" for field in fields),
        "",
        "tests:",
        f"{_INDENT}- name: nothing said",
        f"{_INDENT}  given: {{}}",
        f"{_INDENT}  expect: {{{_column(fields[-1].name)}: {_zero(fields[-1].type)}}}",
    ]
    return "\n".join(lines) + "\n"


def _column(name: str) -> str:
    """Return the column for a field; the envelope has taken one name."""
    return _quoted(f"{name}_" if name == _ENVELOPE else name)


def _quoted(word: str) -> str:
    """Return a word as YAML text, also where it is one of YAML's own."""
    return f'"{word}"' if word.lower() in _YAML_WORDS else word


def _expression(name: str) -> str:
    """Return the expression that reads a field."""
    reserved = name in {"null", "true", "false", "self"} or keyword.iskeyword(name)
    return f"self['{name}']" if reserved else _quoted(name)


def _declared(name: str, type_: DataType) -> Iterator[str]:
    """Yield the lines that declare a column."""
    struct = type_.value_type if is_list(type_) else type_
    known = _known(type_)
    if known is not None:
        yield f"{name}: {known}"
    elif pt.is_struct(struct):
        yield f"{name}:"
        if is_list(type_):
            yield f"{_INDENT}type: list"
        yield f"{_INDENT}fields:"
        for field in struct:
            if _holds_something(field.type):
                yield from (_INDENT * 2 + line for line in _declared(_column(field.name), field.type))
    else:
        yield f"{name}: {spell(type_)}"


def _known(type_: DataType) -> str | None:
    """Return the ontology's word for headers and times, and lists of them."""
    if is_list(type_):
        element = _known(type_.value_type)
        return (
            None
            if element is None
            else spell(listed(arrays.int8(), getattr(type_, "list_size", None))).replace("int8", element)
        )
    if not pt.is_struct(type_):
        return None
    return "Header" if special(type_, HEADER_TYPE) else "Time" if special(type_, STAMP_TYPE) else None


def _holds_something(type_: DataType) -> bool:
    """Return whether a type has any value; messages without fields have none."""
    while is_list(type_):
        type_ = type_.value_type
    return not pt.is_struct(type_) or any(_holds_something(field.type) for field in type_)


def _zero(type_: DataType) -> str:
    """Return what comes out of a field that was not given, as YAML."""
    if pt.is_struct(type_):
        return "null" if special(type_, HEADER_TYPE) else "{}"
    if pt.is_fixed_size_list(type_):
        return f"[{', '.join([_zero(type_.value_type)] * type_.list_size)}]"
    if pt.is_list(type_):
        return "[]"
    if pt.is_string(type_) or pt.is_binary(type_):
        return '""'
    return "false" if pt.is_boolean(type_) else "0"
