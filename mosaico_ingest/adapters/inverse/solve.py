"""This file inverts functions: from a result to the argument."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mosaico_ingest.adapters.mapping.arrow import Array, arrays, pc, pt
from mosaico_ingest.adapters.mapping.columns import field_of
from mosaico_ingest.adapters.mapping.functions.time import STAMP_TYPE

__all__ = ["ONE_ARGUMENT", "with_constant"]

_SECOND_NS = 1_000_000_000


def _same(values: Array) -> Array:
    return values


def _nan(values: Array) -> Array:
    return pc.fill_null(values, arrays.scalar(float("nan"), values.type))


def _yaw(quaternion: Array) -> Array:
    x, y, z, w = (np.asarray(field_of(quaternion, name).fill_null(0.0)) for name in "xyzw")
    return arrays.array(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def _from_seconds(values: Array) -> Array:
    return _from_ns(pc.round(pc.multiply(values, float(_SECOND_NS))))


def _from_ns(values: Array) -> Array:
    whole = np.asarray(filled_int(values))
    seconds, rest = np.divmod(whole, _SECOND_NS)
    children = [arrays.array(seconds.astype(np.int32)), arrays.array(rest.astype(np.uint32))]
    return arrays.StructArray.from_arrays(children, fields=list(STAMP_TYPE))


def _to_ns(values: Array) -> Array:
    seconds, rest = (pc.cast(field_of(values, name), arrays.int64()) for name in ("seconds", "nanoseconds"))
    return pc.add(pc.multiply(seconds, _SECOND_NS), rest)


def filled_int(values: Array) -> Array:
    """Return numbers as int64, 0 where there is none."""
    return pc.fill_null(pc.cast(values, arrays.int64(), safe=False), 0)


ONE_ARGUMENT: Mapping[str, Callable[[Array], Array]] = {
    "covariance": _same,
    "variance": _same,
    "empty_to_null": _same,
    "positive": _same,
    "coalesce": _same,
    "nan_to_null": _nan,
    "negative": pc.negate,
    "not": pc.invert,
    "sqrt": lambda values: pc.multiply(values, values),
    "exp": pc.ln,
    "log": pc.exp,
    "radians": lambda values: pc.multiply(values, 180 / np.pi),
    "degrees": lambda values: pc.multiply(values, np.pi / 180),
    "quaternion_from_yaw": _yaw,
    "seconds": _from_seconds,
    "nanoseconds": _from_ns,
    "time_from_ns": _to_ns,
}
"""By the function's name: what its (first) argument was. A null stands for the field's own zero."""


def with_constant(name: str, values: Array, number: Any, *, first: bool) -> Array | None:  # noqa: ANN401 - a literal
    """Return x of `x name number` (`first`: of `number name x`) where that gave `values`; None where it cannot be."""
    if isinstance(number, bool) or not isinstance(number, (int, float)):
        return None
    if name == "!=" and number == 0:
        return values
    if pt.is_boolean(values.type):
        return None
    solved: dict[tuple[str, bool], Callable[[], Array]] = {
        ("+", False): lambda: pc.subtract(values, number),
        ("+", True): lambda: pc.subtract(values, number),
        ("-", False): lambda: pc.add(values, number),
        ("-", True): lambda: pc.subtract(arrays.scalar(number), values),
        ("*", False): lambda: pc.divide(pc.cast(values, arrays.float64()), float(number)),
        ("*", True): lambda: pc.divide(pc.cast(values, arrays.float64()), float(number)),
        ("/", False): lambda: pc.multiply(values, number),
        ("/", True): lambda: pc.divide(float(number), pc.cast(values, arrays.float64())),
    }
    solve = solved.get((name, first))
    return None if solve is None or (name == "*" and number == 0) else solve()
