"""Deserialize and serialize one message at a time; the reference of the columnar decoder.

The rule ids of deserialization errors:

* `encapsulation`, `pl-cdr`, `xcdr2`: the first four bytes are not the header of plain CDR.
* `truncated`: a field needs more bytes than the message has.
* `string-length`, `string-terminator`, `utf8`, `utf16`: a string extends beyond the message, a CDR string has no
  terminating NUL, or a text is not valid Unicode. Text is never repaired, because a wrong byte means that data is
  damaged or that the definition is wrong.
* `sequence-length`, `sequence-bound`: a sequence has more elements than the remaining bytes or the definition allow.
* `trailing-bytes`: bytes remain after the last field. CDR messages may end with up to 3 bytes of padding, or with 4 to
  7 zero bytes.

A serializer compiles its definition once. Consecutive values of fixed size form one `_Block`, even across nested
structs, and are packed together; texts and sequences are written individually.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from struct import Struct, unpack_from
from typing import Any, Protocol

from mosaico_ingest.errors import BagError, DecodeError
from mosaico_ingest.rosbag.blocks import Encoding
from mosaico_ingest.rosbag.definitions.model import (
    BYTES,
    Container,
    Definition,
    Field,
    MessageType,
    Source,
)
from mosaico_ingest.rosbag.definitions.registry import distro_definitions

FORMATS: Mapping[str, str] = {
    "bool": "B", "byte": "B", "char": "B", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h",
    "uint32": "I", "int32": "i", "uint64": "Q", "int64": "q", "float32": "f", "float64": "d",
}  # fmt: skip
"""The `struct` format of each primitive of fixed size; any nonzero byte is a true `bool`."""

_SIZES = {kind: Struct(f"<{letter}").size for kind, letter in FORMATS.items()}
_MAX_EMPTY = 1 << 16
_MAX_PADDING = 3
_MAX_ZEROS = 7
_XCDR2 = {6: "CDR2", 7: "CDR2", 8: "D_CDR2", 9: "D_CDR2", 10: "PL_CDR2", 11: "PL_CDR2"} | dict.fromkeys(
    range(0x10, 0x18), "CDR2"
)


class _Cursor:
    """A position in the bytes after the encapsulation header, from which CDR counts alignment."""

    __slots__ = ("cdr", "data", "order", "pos")

    def __init__(self, data: bytes, order: str, *, cdr: bool) -> None:
        self.data = data
        self.order = order
        self.cdr = cdr
        self.pos = 0

    @property
    def left(self) -> int:
        return max(0, len(self.data) - self.pos)

    @property
    def offset(self) -> int:
        """The position in the payload, including the encapsulation header."""
        return self.pos + 4 * self.cdr

    def take(self, size: int, align: int, path: str) -> int:
        """Skip the padding and `size` bytes; return the position of the bytes."""
        start = (self.pos + align - 1) & -align if self.cdr else self.pos
        self.pos = start
        if start + size > len(self.data):
            raise DecodeError(
                f"{path}: {size} bytes needed at byte {self.offset}, {self.left} left", rule="truncated"
            )
        self.pos = start + size
        return start

    def word(self, path: str) -> int:
        """Read a length word."""
        start = self.take(4, 4, path)
        return unpack_from(f"{self.order}I", self.data, start)[0]


_Read = Callable[[_Cursor], Any]


class Deserializer:
    """Decodes messages of one definition. Arrays and sequences become lists, sequences of `uint8`, `byte` and `char` `bytes`."""

    def __init__(self, definition: Definition, encoding: Encoding) -> None:
        if encoding not in {Encoding.CDR, Encoding.ROS1}:
            raise BagError(f"{definition.root}: only CDR and ROS 1 payloads can be decoded")
        self._definition = definition
        self._encoding = encoding
        self._cdr = encoding is Encoding.CDR
        self._read = _message(definition.message, "", definition.types, cdr=self._cdr)
        self.padded = 0
        """Number of messages that ended in 4 to 7 zero bytes that the definition does not explain."""

    def to_dict(self, payload: bytes) -> dict[str, Any]:
        """Return the message's fields by name.

        Raises:
            DecodeError: The bytes do not match the definition; `rule` is the rule id.
        """
        try:
            return self._values(payload)
        except DecodeError as error:
            error.hint = self._remedy(payload) if error.rule not in _OTHER_ENCODINGS else None
            raise

    def fits(self, payload: bytes) -> bool:
        """Return whether a payload matches the definition."""
        try:
            self._values(payload)
        except DecodeError:
            return False
        return True

    def _values(self, payload: bytes) -> dict[str, Any]:
        order = _byte_order(payload) if self._cdr else "<"
        cursor = _Cursor(payload[4:] if self._cdr else payload, order, cdr=self._cdr)
        if self._definition.message.fields:
            values: dict[str, Any] = self._read(cursor)
        else:
            values = {}
            cursor.pos = min(1, cursor.left) if self._cdr else 0
        self._check_tail(cursor)
        return values

    def _remedy(self, payload: bytes) -> str | None:
        """Return a hint that names a distro whose definition of the type matches the bytes."""
        definition = self._definition
        others = _distro_readers(definition.root, definition.ros_version, self._encoding)
        matching = (
            distro for distro, types, reader in others if types != definition.types and reader.fits(payload)
        )
        distro = next(matching, None)
        return f"use the definition of {distro}, which matches the bytes" if distro else None

    def _check_tail(self, cursor: _Cursor) -> None:
        remaining = cursor.left
        if remaining <= (_MAX_PADDING if self._cdr else 0):
            return
        if self._cdr and remaining <= _MAX_ZEROS and not any(cursor.data[cursor.pos :]):
            self.padded += 1
            return
        raise DecodeError(
            f"{remaining} bytes remain after the last field of {self._definition.root}, whose definition is from "
            f"{_ORIGINS[self._definition.source]}",
            rule="trailing-bytes",
        )


@lru_cache(maxsize=256)
def _distro_readers(
    msgtype: str, ros_version: int, encoding: Encoding
) -> tuple[tuple[str, Mapping[str, MessageType], Deserializer], ...]:
    definitions = distro_definitions(msgtype, ros_version)
    return tuple((distro, other.types, Deserializer(other, encoding)) for distro, other in definitions)


_OTHER_ENCODINGS = frozenset({"encapsulation", "pl-cdr", "xcdr2"})
_ORIGINS = {
    Source.BAG: "the recording",
    Source.CUSTOM: "a custom definition",
    Source.DISTRO: "the distro's definitions",
    Source.PACKAGE: "a public package",
}


def _byte_order(payload: bytes) -> str:
    """Return `<` or `>` according to the encapsulation header."""
    if len(payload) >= 4 and payload[0] == 0:  # noqa: PLR2004 - size of the CDR header
        kind = payload[1]
        if kind <= 1:
            return "<" if kind else ">"
        if kind in {2, 3}:
            raise DecodeError(
                "the payload is a CDR parameter list (PL_CDR); only plain CDR is read", rule="pl-cdr"
            )
        if kind in _XCDR2:
            raise DecodeError(f"the payload is XCDR2 ({_XCDR2[kind]}); only plain CDR is read", rule="xcdr2")
    raise DecodeError(
        f"no CDR encapsulation header (00 00 or 00 01): {len(payload)} bytes beginning {payload[:16].hex(' ')!r}",
        rule="encapsulation",
    )


def min_size(kind: str, types: Mapping[str, MessageType], *, cdr: bool) -> int:
    """Return the minimum size of a value in bytes, without padding; 0 is possible in ROS 1 only."""
    if kind in _SIZES:
        return _SIZES[kind]
    if kind in {"string", "wstring"}:
        return 4
    fields = types[kind].fields
    return sum(_field_min(field, types, cdr=cdr) for field in fields) if fields else int(cdr)


def _field_min(field: Field, types: Mapping[str, MessageType], *, cdr: bool) -> int:
    if field.container is Container.SEQUENCE:
        return 4
    count = field.size if field.container is Container.ARRAY else 1
    return count * min_size(field.type, types, cdr=cdr)


def _message(message: MessageType, path: str, types: Mapping[str, MessageType], *, cdr: bool) -> _Read:
    prefix = f"{path}." if path else ""
    readers = [(field.name, _field(field, prefix + field.name, types, cdr=cdr)) for field in message.fields]
    if readers or not cdr:
        return lambda cursor: {name: read(cursor) for name, read in readers}

    def read_empty(cursor: _Cursor) -> dict[str, Any]:
        cursor.take(1, 1, path)  # ROS 2 represents an empty struct by one unused byte
        return {}

    return read_empty


def _field(field: Field, path: str, types: Mapping[str, MessageType], *, cdr: bool) -> _Read:
    if field.container is Container.SCALAR:
        return _value(field, path, types, cdr=cdr)
    if field.type in FORMATS:
        return _numbers(field, path)
    read = _value(field, f"{path}[]", types, cdr=cdr)
    if field.container is Container.ARRAY:
        size = field.size
        return lambda cursor: [read(cursor) for _ in range(size)]
    least = min_size(field.type, types, cdr=cdr)
    return lambda cursor: [read(cursor) for _ in range(_count(cursor, field, path, least))]


def _value(field: Field, path: str, types: Mapping[str, MessageType], *, cdr: bool) -> _Read:
    if field.is_message:
        return _message(types[field.type], path, types, cdr=cdr)
    if field.type == "string":
        return lambda cursor: _string(cursor, path)
    if field.type == "wstring":
        return lambda cursor: _wstring(cursor, path)
    return _number(field.type, path)


def _number(kind: str, path: str) -> _Read:
    size = _SIZES[kind]
    little, big = Struct(f"<{FORMATS[kind]}").unpack_from, Struct(f">{FORMATS[kind]}").unpack_from

    def read(cursor: _Cursor) -> int | float:
        start = cursor.take(size, size, path)
        return (little if cursor.order == "<" else big)(cursor.data, start)[0]

    return (lambda cursor: bool(read(cursor))) if kind == "bool" else read


def _numbers(field: Field, path: str) -> _Read:
    """Return a reader of a sequence or array of numbers. Empty ones are not aligned."""
    kind, size, letter = field.type, _SIZES[field.type], FORMATS[field.type]
    fixed = field.size if field.container is Container.ARRAY else None

    def read(cursor: _Cursor) -> bytes | list[Any]:
        count = _count(cursor, field, path, size) if fixed is None else fixed
        start = cursor.take(count * size, size, path) if count else cursor.pos
        if kind in BYTES and fixed is None:
            return cursor.data[start : start + count]
        values = unpack_from(f"{cursor.order}{count}{letter}", cursor.data, start)
        return list(map(bool, values)) if kind == "bool" else list(values)

    return read


def _count(cursor: _Cursor, field: Field, path: str, least: int) -> int:
    """Read the number of elements, and check it against the remaining bytes and the bound."""
    count = cursor.word(path)
    if count * least > cursor.left or (not least and count > _MAX_EMPTY):
        raise DecodeError(
            f"{path}: {count} elements of at least {least} bytes at byte {cursor.offset}, {cursor.left} bytes left",
            rule="sequence-length",
        )
    if field.size and count > field.size:
        raise DecodeError(
            f"{path}: {count} elements, at most {field.size} are allowed", rule="sequence-bound"
        )
    return count


def _string(cursor: _Cursor, path: str) -> str:
    size = cursor.word(path)
    if size > cursor.left:
        raise DecodeError(
            f"{path}: a string of {size} bytes at byte {cursor.offset}, {cursor.left} left",
            rule="string-length",
        )
    start, cursor.pos = cursor.pos, cursor.pos + size
    end = cursor.pos
    if cursor.cdr and size:
        end -= 1
        if cursor.data[end]:
            raise DecodeError(
                f"{path}: the string of {size} bytes does not end in NUL", rule="string-terminator"
            )
    try:
        return cursor.data[start:end].decode()
    except UnicodeDecodeError as error:
        raise DecodeError(f"{path}: byte {error.start} of the string is not UTF-8", rule="utf8") from None


def _wstring(cursor: _Cursor, path: str) -> str:
    """Read UTF-16 code units, which all ROS 2 middlewares write as 32-bit words without a terminator."""
    count = cursor.word(path)
    if count * 4 > cursor.left:
        raise DecodeError(
            f"{path}: a string of {count} units at byte {cursor.offset}, {cursor.left} bytes left",
            rule="string-length",
        )
    units = unpack_from(f"{cursor.order}{count}I", cursor.data, cursor.pos)
    cursor.pos += count * 4
    try:
        return b"".join(chr(unit).encode("utf-16-le", "surrogatepass") for unit in units).decode("utf-16-le")
    except (UnicodeDecodeError, ValueError, OverflowError):
        raise DecodeError(f"{path}: the string is not UTF-16", rule="utf16") from None


_Path = tuple[str, ...]
"""The field names that lead to a value."""


class Serializer:
    """Encodes messages of one definition, little-endian by default."""

    def __init__(self, definition: Definition, encoding: Encoding, *, big_endian: bool = False) -> None:
        if encoding not in {Encoding.CDR, Encoding.ROS1} or (encoding is Encoding.ROS1 and big_endian):
            raise BagError(f"{definition.root}: only CDR and little-endian ROS 1 payloads can be encoded")
        self._definition = definition
        self._cdr = encoding is Encoding.CDR
        self._order = ">" if big_endian else "<"
        self._header = (b"\x00\x00\x00\x00" if big_endian else b"\x00\x01\x00\x00") if self._cdr else b""
        self._known: dict[str, list[_Step]] = {}
        self._steps = self._steps_of(definition.root)

    def from_dict(self, values: Mapping[str, Any]) -> bytes:
        """Return the payload of a message in the form that `Deserializer.to_dict` returns.

        Raises:
            BagError: A value is missing or does not match its field.
        """
        out = bytearray()
        try:
            for step in self._steps:
                step.write(out, values)
        except (struct.error, KeyError, TypeError, ValueError, AttributeError) as error:
            raise BagError(f"the values do not match {self._definition.root}: {error!r}") from error
        return self._header + bytes(out)

    def _steps_of(self, msgtype: str) -> list[_Step]:
        """Return the cached steps that write a message of this type."""
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
        """Append the step's value from the values of its message."""
        ...


class _Elements(Protocol):
    def extend(self, out: bytearray, values: Sequence[Any]) -> None:
        """Append every element of an array or a sequence."""
        ...


class _Nothing:
    """A message without fields, which CDR represents by one byte."""

    def write(self, out: bytearray, values: Mapping[str, Any]) -> None:  # noqa: ARG002 - the message has no values
        out.append(0)


class _Block:
    """Consecutive numbers; the padding between them depends on the position of the first one."""

    def __init__(self, order: str, *, aligned: bool) -> None:
        self._order = order
        self._aligned = aligned
        self._parts: list[tuple[_Path, str, int | None]] = []
        self._packers: dict[int, struct.Struct] = {}

    def add(self, path: _Path, letter: str, count: int | None) -> None:
        """Append a number, or an array of `count` numbers."""
        self._parts.append((path, letter, count))

    def write(self, out: bytearray, values: Mapping[str, Any]) -> None:
        flat_values: list[Any] = []
        for path, _, count in self._parts:
            value = _at(values, path)
            if count is None:
                flat_values.append(value)
            else:
                _check_length(path[-1], value, count)
                flat_values.extend(value)
        start = len(out) % 8 if self._aligned else 0
        if start not in self._packers:
            self._packers[start] = self._packer(start)
        out += self._packers[start].pack(*flat_values)

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
    """A sequence of numbers of one type."""

    def __init__(self, order: str, letter: str, *, aligned: bool) -> None:
        self._order = order
        self._letter = letter
        self._align = struct.calcsize(f"<{letter}") if aligned else 1

    def extend(self, out: bytearray, values: Sequence[Any]) -> None:
        if len(values):
            out += bytes(-len(out) % self._align)
            out += struct.pack(f"{self._order}{len(values)}{self._letter}", *values)


class _Texts:
    """Strings: a length word and UTF-8, which CDR terminates with NUL, or UTF-16 units of four bytes."""

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
    """One string."""

    def __init__(self, path: _Path, texts: _Texts) -> None:
        self._path = path
        self._texts = texts

    def write(self, out: bytearray, values: Mapping[str, Any]) -> None:
        self._texts.extend(out, (_at(values, self._path),))


class _Many:
    """An array, or a sequence with its length word."""

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
    value: Any = values
    for name in path:
        value = value[name]
    return value


def _check_length(name: str, value: Sequence[Any], size: int) -> None:
    if len(value) != size:
        raise ValueError(f"{name} has {len(value)} elements instead of {size}")
