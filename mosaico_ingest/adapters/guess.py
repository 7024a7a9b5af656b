"""This file guesses what fills the columns of an ontology type: fields of the message with an equal name."""

from __future__ import annotations

import keyword
from collections.abc import Iterator, Sequence

import pyarrow as pa

from mosaico_ingest.adapters.builtin import BY_TYPE
from mosaico_ingest.adapters.mapping.arrow import DataType, pt
from mosaico_ingest.adapters.mapping.fit import demand
from mosaico_ingest.adapters.mapping.kinds import Unfit, is_number, kind_of, spell
from mosaico_ingest.adapters.yamltext import key, word
from mosaico_ingest.bag.definition import Container, Definition, Field
from mosaico_ingest.bag.msgtext import BYTES
from mosaico_ingest.bag.shape import TEXTS, ros_shape
from mosaico_ingest.frozen import frozen
from mosaico_ingest.ontology.registry import ontology_type

__all__ = ["Guess", "guess_columns", "guess_type"]

_RESERVED = frozenset({"self", "nan", "inf", "pi", "true", "false", "null"})
"""What means something else in an expression."""
_TELLING = 4
"""From how many letters on a column's name is looked for inside longer ones."""


@frozen
class Guess:
    """What may fill a column."""

    name: str
    value: str | None
    """As the file spells it, the `of` of one with fields; None: nothing is known, the column stays null."""
    note: str = ""
    """What a reader should know: the column's type, and what was taken for it."""
    fields: tuple[Guess, ...] = ()


@frozen
class _Candidate:
    """A field of the message, however deep, but not inside a list."""

    path: tuple[str, ...]
    type: DataType
    msgtype: str | None
    """Where it is a message, or a list of them: which."""
    listed: bool

    @property
    def text(self) -> str:
        return _expression(*self.path)


def guess_columns(struct: DataType, definition: Definition, shape: pa.StructType) -> tuple[Guess, ...]:
    """Return a guess for every column of an ontology type; one that is required gets some value."""
    known = sorted(_candidates(definition, definition.root, shape, ()), key=lambda one: len(one.path))
    return tuple(_column(field, known) for field in struct)


def _column(field: DataType, known: Sequence[_Candidate]) -> Guess:
    type_ = spell(field.type)
    for some in _by_likeness(field, known):
        values = [value for one in some if (value := _fitting(one, field.type)) is not None]
        if len(values) == 1:
            return Guess(field.name, values[0], f"{type_}, {'may be null' if field.nullable else 'required'}")
    perhaps = ", ".join(
        one.text for one in known if len(one.path) == 1 and _resembles(field.name, one.path[0])
    )
    note = f"{type_}, perhaps {perhaps}" if perhaps else type_
    if field.nullable:
        return Guess(field.name, None, note)
    if pt.is_struct(field.type):
        inner = tuple(_column(child, ()) for child in field.type)
        return Guess(field.name, None, "required: no field is called so", inner)
    return Guess(field.name, _nothing(field.type), f"{note}, required: no field is called so")


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
        demand(kind_of(source, msgtype=msgtype), target)
    except Unfit:
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


def guess_type(definition: Definition) -> tuple[list[str], tuple[Guess, ...]]:
    """Return the fields of an ontology type of one's own as lines of YAML, and what fills each."""
    made = _own_fields(definition, definition.root, ros_shape(definition), "    ", top=True)
    return [line for lines, _ in made for line in lines], tuple(guess for _, some in made for guess in some)


_Made = tuple[list[str], list[Guess]]


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
        return [f"{margin}{key(name)}: {spell(type_)}"], [Guess(name, word(text))]
    used = _adapted(field.type, listed=listed)
    if used is not None:
        tag = BY_TYPE[field.type].tag
        own = word(text) if tag == "Header" and not listed else _by_adapter(used[0], text, listed=listed)
        return [f"{margin}{key(name)}: {f'list[{tag}]' if listed else tag}"], [Guess(name, own)]
    if listed:
        return _spread(definition, field, margin)
    inner = _own_fields(definition, field.type, type_, margin + "    ")
    lines = [line for part, _ in inner for line in part]
    guesses = tuple(guess for _, part in inner for guess in part)
    if not lines:
        return [], []
    return [f"{margin}{key(name)}:", f"{margin}  fields:", *lines], [Guess(name, word(text), fields=guesses)]


def _spread(definition: Definition, field: Field, margin: str) -> _Made:
    """Return a list for each plain field of a list's messages; what nests deeper is left to the author."""
    made: _Made = ([], [])
    for child in definition.types[field.type].fields:
        if not child.is_message and child.container is Container.SCALAR:
            name = f"{field.name}_{child.name}"
            kind = "uint8" if child.type in BYTES else "string" if child.type in TEXTS else child.type
            made[0].append(f"{margin}{key(name)}: list[{kind}]")
            made[1].append(Guess(name, f"{_expression(field.name)}[]{_expression('', child.name)}"))
    return made
