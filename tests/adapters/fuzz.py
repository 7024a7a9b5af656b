"""Random messages of any definition as plain dicts, including values that adapters treat specially."""

from __future__ import annotations

from random import Random
from typing import Any

from mosaico_ingest.rosbag.definitions.model import TIME, Container, Definition, Field

_SPECIAL_FLOATS = (0.0, 0.0, 1.0, -1.0, 0.5, float("nan"), float("inf"), float("-inf"))
_TEXTS = ("", "", "map", "base_link", "überall", "bgr8; jpeg compressed bgr8", "png")
_BITS = {
    "uint8": 8,
    "byte": 8,
    "char": 8,
    "uint16": 16,
    "uint32": 32,
    "uint64": 64,
    "int8": -8,
    "int16": -16,
    "int32": -32,
    "int64": -64,
}
_DYADIC = 1024
"""Floats with few bits are equal in both widths."""


def message(definition: Definition, random: Random) -> dict[str, Any]:
    """Return one message of the type, by field name."""
    return _struct(definition, definition.root, random)


def _struct(definition: Definition, name: str, random: Random) -> dict[str, Any]:
    values = {field.name: _field(definition, field, random) for field in definition.types[name].fields}
    if name == TIME:
        values["nanosec"] %= 1_000_000_000
    return values


def _field(definition: Definition, field: Field, random: Random) -> Any:
    if field.container is Container.SCALAR:
        return _one(definition, field, random)
    count = field.size if field.container is Container.ARRAY else random.choice((0, 1, 2, 5))
    if field.type in {"uint8", "byte", "char"} and field.container is Container.SEQUENCE:
        return random.randbytes(count)
    if field.container is Container.ARRAY and field.type == "float64" and random.random() < 0.5:
        return [random.choice((0.0, -1.0)) if i == 0 else 0.0 for i in range(count)]
    return [_one(definition, field, random) for _ in range(count)]


def _one(definition: Definition, field: Field, random: Random) -> Any:
    if field.is_message:
        return _struct(definition, field.type, random)
    if field.type == "bool":
        return random.random() < 0.5
    if field.type in {"string", "wstring"}:
        return random.choice(_TEXTS)
    if field.type.startswith("float"):
        return random.choice(
            (*_SPECIAL_FLOATS, *(random.randrange(-(2**20), 2**20) / _DYADIC for _ in range(8)))
        )
    return _integer(_BITS[field.type], random)


def _integer(bits: int, random: Random) -> int:
    low, high = (0, 2**bits - 1) if bits > 0 else (-(2 ** (-bits - 1)), 2 ** (-bits - 1) - 1)
    return random.choice((0, 0, 1, 2, 3, low, high, random.randint(low, high)))
