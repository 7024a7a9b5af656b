"""Messages of any definition with values that happen: zeros, empty lists, NaN, full ranges."""

from __future__ import annotations

import random
import string
from typing import Any

import pyarrow as pa

STAMP = ["sec", "nanosec"]
LONGEST = 3
_ZERO: dict[str, Any] = {"binary": b"", "string": "", "bool": False}


def random_rows(shape: pa.StructType, count: int, *, seed: int = 0) -> pa.StructArray:
    """Return `count` messages in the ROS shape, the first of them all zero."""
    chance = random.Random(seed)  # noqa: S311 - values for tests
    return pa.array([_value(shape, chance if row else None) for row in range(count)], shape)


def _value(kind: pa.DataType, chance: random.Random | None) -> Any:
    if pa.types.is_struct(kind):
        return _struct(kind, chance)
    if pa.types.is_fixed_size_list(kind):
        zero = chance is None or chance.random() < 0.3
        return [_value(kind.value_type, None if zero else chance) for _ in range(kind.list_size)]
    if pa.types.is_list(kind):
        length = chance.randint(0, LONGEST) if chance else 0
        return [_value(kind.value_type, chance) for _ in range(length)]
    if chance is None:
        return _ZERO.get(str(kind), 0)
    return _scalar(kind, chance)


def _scalar(kind: pa.DataType, chance: random.Random) -> Any:
    if pa.types.is_binary(kind):
        return chance.randbytes(chance.randint(0, LONGEST))
    if pa.types.is_string(kind):
        return "".join(chance.choices(string.printable, k=chance.randint(0, 5)))
    if pa.types.is_boolean(kind):
        return chance.random() < 0.5
    return _float(kind, chance) if pa.types.is_floating(kind) else _integer(kind, chance)


def _struct(kind: pa.StructType, chance: random.Random | None) -> dict[str, Any]:
    value = {field.name: _value(field.type, chance) for field in kind}
    if [field.name for field in kind] == STAMP:
        value["nanosec"] %= 1_000_000_000
    return value


def _float(kind: pa.DataType, chance: random.Random) -> float:
    value = chance.choice(
        [0.0, -0.0, 1.0, -1.0, float("nan"), float("inf"), chance.gauss(0, 10), chance.random()]
    )
    return pa.scalar(value, kind).as_py()


def _integer(kind: pa.DataType, chance: random.Random) -> int:
    top = 2 ** (kind.bit_width - (0 if pa.types.is_unsigned_integer(kind) else 1)) - 1
    low = 0 if pa.types.is_unsigned_integer(kind) else -top - 1
    return chance.choice([0, 1, chance.randint(0, 7), top, low, chance.randint(low, top)])
