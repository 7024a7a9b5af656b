"""This file writes the first draft of an adapter file: every field of a message type, ready to be cut down."""

from __future__ import annotations

import keyword
from collections.abc import Iterator

from mosaico_ingest.adapters.mapping.arrow import DataType, arrays, pt
from mosaico_ingest.adapters.mapping.fit import demand, special
from mosaico_ingest.adapters.mapping.functions.ros import HEADER_TYPE
from mosaico_ingest.adapters.mapping.functions.time import STAMP_TYPE
from mosaico_ingest.adapters.mapping.kinds import Unfit, is_list, is_number, kind_of, listed, spell
from mosaico_ingest.bag.definition import Definition
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.ontology.tags import MODULES
from mosaico_ingest.ontology.types import OntologyType

__all__ = ["draft_adapter"]

_INDENT = "  "
_ENVELOPE = "timestamp_ns"
_YAML_WORDS = frozenset({"y", "n", "yes", "no", "on", "off", "true", "false", "null"})


def draft_adapter(
    definition: Definition, shape: DataType, *, name: str | None = None, ontology: OntologyType | None = None
) -> str:
    """Return an adapter file (YAML) for a message type.

    Without `ontology` it has a type of its own with every field; with it, columns take the fields that have their
    names, a required one without is zero, and comments say what is left on either side.

    Raises:
        AdapterError: The type has no fields.
    """
    short = definition.root.rsplit("/", 1)[-1]
    fields = [field for field in shape if _holds_something(field.type)]
    if not fields:
        raise AdapterError(f"{definition.root} has no fields", hint="there is nothing to adapt")
    head = ["version: 1", f"adapter: {name or f'{short}Adapter'}", f"ros_type: {definition.root}"]
    if ontology is None:
        lines = [*head, *_own_type(short, fields), *_case(_column(fields[-1].name), _zero(fields[-1].type))]
    else:
        columns, used = _guesses(ontology.struct, fields)
        unused = ", ".join(field.name for field in fields if field.name not in used)
        left = [f"{_INDENT}# not used: {unused}"] if unused else []
        filled = (
            "fields:"
            if any("# " not in line[:4] for line in columns)
            else "fields: {}  # no field has a column's name"
        )
        lines = [*head, f"ontology: {ontology.tag}", "", filled, *columns, *left, *_case("", "")]
    return "\n".join(lines) + "\n"


def _own_type(short: str, fields: list[DataType]) -> list[str]:
    """Return the lines of an ontology type that has every field, and of the fields that fill it."""
    return [
        "ontology:",
        f"{_INDENT}tag: {f'{short}Message' if short in MODULES else short}",
        f"{_INDENT}fields:",
        *(_INDENT * 2 + line for field in fields for line in _declared(_column(field.name), field.type)),
        "",
        "fields:",
        *(f"{_INDENT}{_column(field.name)}: {_expression(field.name)}" for field in fields),
    ]


def _case(column: str, value: str) -> list[str]:
    """Return the lines of a first test: a message in which nothing is said."""
    expected = f"{column}: {value}" if column else ""
    head = ["", "tests:", f"{_INDENT}- name: nothing said"]
    return [*head, f"{_INDENT}  given: {{}}", f"{_INDENT}  expect: {{{expected}}}"]


def _guesses(target: DataType, fields: list[DataType]) -> tuple[list[str], set[str]]:
    """Return a line for each column, and the names of the fields that were used."""
    lines: list[str] = []
    used: set[str] = set()
    by_letters = {_letters(field.name): field for field in fields}
    for column in target:
        field = by_letters.get(_letters(column.name))
        read = _reading(field, column.type) if field is not None else None
        if field is not None and read is not None:
            used.add(field.name)
            lines.append(f"{_INDENT}{column.name}: {read}")
        elif column.nullable:
            lines.append(f"{_INDENT}# {column.name}:  # {spell(column.type)}")
        else:
            lines.append(
                f"{_INDENT}{column.name}: {_placeholder(column.type)}  # required: {spell(column.type)}"
            )
    return lines, used


def _reading(field: DataType, target: DataType) -> str | None:
    """Return the expression that makes a field fit, None if there is none."""
    expression = _expression(field.name)
    try:
        demand(kind_of(field.type), target)
    except Unfit:
        numbers = is_number(field.type) and (is_number(target) or pt.is_boolean(target))
        return f"cast({expression})" if numbers else None
    return expression


def _letters(name: str) -> str:
    return name.replace("_", "").lower()


def _placeholder(type_: DataType) -> str:
    """Return a value for a required column that nothing was found for."""
    if pt.is_struct(type_):
        inner = (f"{field.name}: {_placeholder(field.type)}" for field in type_ if not field.nullable)
        return f"{{fields: {{{', '.join(inner)}}}}}"
    if pt.is_fixed_size_list(type_):
        return f'"[{", ".join(["0"] * type_.list_size)}]"'
    if pt.is_list(type_):
        return '"[]"'
    if pt.is_string(type_):
        return "\"''\""
    if pt.is_binary(type_):
        return "\"bytes([cast(0, 'uint8')])\""
    return "false" if pt.is_boolean(type_) else "0"


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
