"""Random messages of any definition, with zeros, empty lists, NaN and limits of ranges."""

from __future__ import annotations

import random
import string
from typing import Any

import pyarrow as pa

STAMP = ["sec", "nanosec"]
MAX_LENGTH = 3
_ZERO: dict[str, Any] = {"binary": b"", "string": "", "bool": False}


def random_rows(shape: pa.StructType, count: int, *, seed: int = 0) -> pa.StructArray:
    """Return `count` messages in the ROS shape; all values of the first one are zero."""
    generator = random.Random(seed)  # noqa: S311 - values for tests
    return pa.array([_value(shape, generator if row else None) for row in range(count)], shape)


def _value(kind: pa.DataType, generator: random.Random | None) -> Any:
    if pa.types.is_struct(kind):
        return _struct(kind, generator)
    if pa.types.is_fixed_size_list(kind):
        zero = generator is None or generator.random() < 0.3
        return [_value(kind.value_type, None if zero else generator) for _ in range(kind.list_size)]
    if pa.types.is_list(kind):
        length = generator.randint(0, MAX_LENGTH) if generator else 0
        return [_value(kind.value_type, generator) for _ in range(length)]
    if generator is None:
        return _ZERO.get(str(kind), 0)
    return _scalar(kind, generator)


def _scalar(kind: pa.DataType, generator: random.Random) -> Any:
    if pa.types.is_binary(kind):
        return generator.randbytes(generator.randint(0, MAX_LENGTH))
    if pa.types.is_string(kind):
        return "".join(generator.choices(string.printable, k=generator.randint(0, 5)))
    if pa.types.is_boolean(kind):
        return generator.random() < 0.5
    return _float(kind, generator) if pa.types.is_floating(kind) else _integer(kind, generator)


def _struct(kind: pa.StructType, generator: random.Random | None) -> dict[str, Any]:
    value = {field.name: _value(field.type, generator) for field in kind}
    if [field.name for field in kind] == STAMP:
        value["nanosec"] %= 1_000_000_000
    return value


def _float(kind: pa.DataType, generator: random.Random) -> float:
    value = generator.choice(
        [0.0, -0.0, 1.0, -1.0, float("nan"), float("inf"), generator.gauss(0, 10), generator.random()]
    )
    return pa.scalar(value, kind).as_py()


def _integer(kind: pa.DataType, generator: random.Random) -> int:
    top = 2 ** (kind.bit_width - (0 if pa.types.is_unsigned_integer(kind) else 1)) - 1
    low = 0 if pa.types.is_unsigned_integer(kind) else -top - 1
    return generator.choice([0, 1, generator.randint(0, 7), top, low, generator.randint(low, top)])
