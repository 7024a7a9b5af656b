"""This file writes messages from plain values, the inverse of `deserialize`.

A definition is walked once, when a serializer is made. Values of fixed size that follow each other are one `_Block`,
whatever the structs they belong to, and are packed together; texts and sequences are written one by one.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol

from mosaico_ingest.bag.batch import Encoding
from mosaico_ingest.bag.definition import Container, Definition, Field
from mosaico_ingest.bag.deserialize import FORMATS
from mosaico_ingest.bag.msgtext import BYTES
from mosaico_ingest.errors import BagError

__all__ = ["Serializer"]

_Path = tuple[str, ...]
"""The names on the way to a value."""


class Serializer:
    """Writes messages of one definition, little-endian unless told otherwise."""

    def __init__(self, definition: Definition, encoding: Encoding, *, big_endian: bool = False) -> None:
        if encoding is Encoding.OTHER or (encoding is Encoding.ROS1 and big_endian):
            raise BagError(f"{definition.root}: only CDR and little-endian ROS 1 payloads can be written")
        self._definition = definition
        self._cdr = encoding is Encoding.CDR
        self._order = ">" if big_endian else "<"
        self._header = (b"\x00\x00\x00\x00" if big_endian else b"\x00\x01\x00\x00") if self._cdr else b""
        self._known: dict[str, list[_Step]] = {}
        self._steps = self._steps_of(definition.root)

    def from_dict(self, values: Mapping[str, Any]) -> bytes:
        """Return the payload of a message given as `Deserializer.to_dict` gives it.

        Raises:
            BagError: A value is missing or does not fit its field.
        """
        out = bytearray()
        try:
            for step in self._steps:
                step.write(out, values)
        except (struct.error, KeyError, TypeError, ValueError, AttributeError) as error:
            raise BagError(f"the values do not fit {self._definition.root}: {error!r}") from error
        return self._header + bytes(out)

    def _steps_of(self, msgtype: str) -> list[_Step]:
        """Return how a message of this type is written; a type may be inside a sequence of its own."""
        if msgtype not in self._known:
            steps = self._known[msgtype] = []
            self._add_message(steps, msgtype, ())
        return self._known[msgtype]

    def _add_message(self, steps: list[_Step], msgtype: str, above: _Path) -> None:
        fields = self._definition.types[msgtype].fields
        for field in fields:
            self._add_field(steps, field, (*above, field.name))
        if not fields and self._cdr:
            steps.append(_Nothing())

    def _add_field(self, steps: list[_Step], field: Field, path: _Path) -> None:
        scalar = field.container is Container.SCALAR
        if scalar and field.is_message:
            self._add_message(steps, field.type, path)
        elif field.type in FORMATS and (
            scalar or (field.container is Container.ARRAY and field.type not in BYTES)
        ):
            block = steps[-1] if steps else None
            if not isinstance(block, _Block):
                block = _Block(self._order, aligned=self._cdr)
                steps.append(block)
            block.add(path, FORMATS[field.type], None if scalar else field.size)
        elif scalar:
            steps.append(_Text(path, self._texts(field)))
        else:
            steps.append(_Many(path, field, self._words("I"), self._elements(field)))

    def _elements(self, field: Field) -> _Elements:
        if field.type in BYTES:
            return _Bytes()
        if field.type in FORMATS:
            return self._words(FORMATS[field.type])
        if field.is_message:
            return _Messages(self._steps_of(field.type))
        return self._texts(field)

    def _texts(self, field: Field) -> _Texts:
        return _Texts(self._words("I"), wide=field.type == "wstring", ended=self._cdr)

    def _words(self, letter: str) -> _Words:
        return _Words(self._order, letter, aligned=self._cdr)


class _Step(Protocol):
    def write(self, out: bytearray, values: Mapping[str, Any]) -> None:
        """Append what the step is about, found in the values of its message."""
        ...


class _Elements(Protocol):
    def extend(self, out: bytearray, values: Sequence[Any]) -> None:
        """Append every element of an array or a sequence."""
        ...


class _Nothing:
    """A message without fields, which CDR gives one byte."""

    def write(self, out: bytearray, values: Mapping[str, Any]) -> None:  # noqa: ARG002 - there are none
        out.append(0)


class _Block:
    """Numbers that follow each other; the padding between them depends on where the first one begins."""

    def __init__(self, order: str, *, aligned: bool) -> None:
        self._order = order
        self._aligned = aligned
        self._parts: list[tuple[_Path, str, int | None]] = []
        self._packers: dict[int, struct.Struct] = {}

    def add(self, path: _Path, letter: str, count: int | None) -> None:
        """Append a number, or an array of so many."""
        self._parts.append((path, letter, count))

    def write(self, out: bytearray, values: Mapping[str, Any]) -> None:
        found: list[Any] = []
        for path, _, count in self._parts:
            value = _at(values, path)
            if count is None:
                found.append(value)
            else:
                _check_length(path[-1], value, count)
                found.extend(value)
        start = len(out) % 8 if self._aligned else 0
        if start not in self._packers:
            self._packers[start] = self._packer(start)
        out += self._packers[start].pack(*found)

    def _packer(self, start: int) -> struct.Struct:
        spelled, at = self._order, start
        for _, letter, count in self._parts:
            if count != 0:
                size = struct.calcsize(f"<{letter}")
                padding = -at % size if self._aligned else 0
                spelled += f"{padding}x{'' if count is None else count}{letter}"
                at += padding + size * (1 if count is None else count)
        return struct.Struct(spelled)


class _Words:
    """Numbers of one kind, any number of them."""

    def __init__(self, order: str, letter: str, *, aligned: bool) -> None:
        self._order = order
        self._letter = letter
        self._align = struct.calcsize(f"<{letter}") if aligned else 1

    def extend(self, out: bytearray, values: Sequence[Any]) -> None:
        if len(values):
            out += bytes(-len(out) % self._align)
            out += struct.pack(f"{self._order}{len(values)}{self._letter}", *values)


class _Texts:
    """Texts: a length word, and UTF-8 that CDR ends in NUL, or UTF-16 units of four bytes."""

    def __init__(self, words: _Words, *, wide: bool, ended: bool) -> None:
        self._words = words
        self._wide = wide
        self._ended = ended

    def extend(self, out: bytearray, values: Iterable[str]) -> None:
        for value in values:
            if self._wide:
                data = value.encode("utf-16-le")
                units = struct.unpack(f"<{len(data) // 2}H", data)
                self._words.extend(out, (len(units),))
                self._words.extend(out, units)
            else:
                text = value.encode() + b"\0" * self._ended
                self._words.extend(out, (len(text),))
                out += text


class _Text:
    """One text."""

    def __init__(self, path: _Path, texts: _Texts) -> None:
        self._path = path
        self._texts = texts

    def write(self, out: bytearray, values: Mapping[str, Any]) -> None:
        self._texts.extend(out, (_at(values, self._path),))


class _Many:
    """An array or a sequence; the latter has its length before it."""

    def __init__(self, path: _Path, field: Field, length: _Words, elements: _Elements) -> None:
        self._path = path
        self._field = field
        self._length = length
        self._elements = elements

    def write(self, out: bytearray, values: Mapping[str, Any]) -> None:
        value = _at(values, self._path)
        size = self._field.size
        if self._field.container is Container.ARRAY:
            _check_length(self._field.name, value, size)
        elif size and len(value) > size:
            raise ValueError(f"{self._field.name} has {len(value)} elements, at most {size} are allowed")
        else:
            self._length.extend(out, (len(value),))
        self._elements.extend(out, value)


class _Bytes:
    def extend(self, out: bytearray, values: Sequence[Any]) -> None:
        out += bytes(values)


class _Messages:
    def __init__(self, steps: Sequence[_Step]) -> None:
        self._steps = steps

    def extend(self, out: bytearray, values: Iterable[Mapping[str, Any]]) -> None:
        for value in values:
            for step in self._steps:
                step.write(out, value)


def _at(values: Mapping[str, Any], path: _Path) -> Any:  # noqa: ANN401 - a field's value
    found: Any = values
    for name in path:
        found = found[name]
    return found


def _check_length(name: str, value: Sequence[Any], size: int) -> None:
    if len(value) != size:
        raise ValueError(f"{name} has {len(value)} elements instead of {size}")
