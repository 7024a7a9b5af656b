"""This file is the functions of time stamps and durations."""

from __future__ import annotations

import numpy as np

from mosaico_ingest.adapters.mapping.arrow import Array, DataType, arrays, pc, pt
from mosaico_ingest.adapters.mapping.columns import field_of, nulls, true_where
from mosaico_ingest.adapters.mapping.functions.operators import numbers, whole
from mosaico_ingest.adapters.mapping.functions.registry import (
    INTEGER,
    Refuse,
    function,
    nullified,
    struct_with,
)
from mosaico_ingest.adapters.mapping.kinds import Kind

__all__ = ["STAMP", "STAMP_TYPE", "as_stamp", "stamp_parts"]

SECOND_NS = 1_000_000_000
STAMP_TYPE: DataType = arrays.struct(
    [
        arrays.field("seconds", arrays.int32(), nullable=False),
        arrays.field("nanoseconds", arrays.uint32(), nullable=False),
    ]
)
"""The ontology's time: what `Time` and `Duration` are, and a header's `timestamp`."""
STAMP = struct_with(
    "a time or duration",
    {"sec": pt.is_integer, "nanosec": pt.is_integer},
    {"seconds": pt.is_integer, "nanoseconds": pt.is_integer},
)
_INT32 = (-(2**31), 2**31 - 1)


def stamp_parts(t: Array) -> tuple[Array, Array]:
    """Return the seconds and the nanoseconds, in ROS's or the ontology's spelling."""
    names = ("sec", "nanosec") if t.type.get_field_index("sec") >= 0 else ("seconds", "nanoseconds")
    return field_of(t, names[0]), field_of(t, names[1])


def as_stamp(refuse: Refuse, t: Array) -> Array:
    """Return `{sec, nanosec}` as the ontology's time; the fields are shared where their types agree."""
    sec, nanosec = stamp_parts(t)
    over = true_where(pc.greater_equal(nanosec, SECOND_NS))
    if over.any():
        refuse(over, "nanosec", lambda i: f"nanosec is {nanosec[i]}; it must be below 1e9")
        nanosec = nullified(nanosec, over)
    children = [pc.cast(sec, arrays.int32()), pc.cast(nanosec, arrays.uint32())]
    absent = nulls(t)
    mask = None if absent is None else arrays.array(absent)
    return arrays.StructArray.from_arrays(children, fields=list(STAMP_TYPE), mask=mask)


@function(STAMP, gives=STAMP_TYPE)
def ros_time(refuse: Refuse, t: Array) -> Array:
    """`{sec, nanosec}` as `{seconds, nanoseconds}`; nanosec of 1e9 or more rejects the row."""
    return as_stamp(refuse, t)


@function(STAMP, gives=arrays.float64())
def seconds(t: Array) -> Array:
    """A time or duration in s."""
    sec, nanosec = stamp_parts(t)
    fraction = pc.multiply(pc.cast(nanosec, arrays.float64()), 1e-9)
    return pc.add(pc.cast(sec, arrays.float64()), fraction)


def _whole(_: Kind) -> Kind:
    return whole()


@function(STAMP, gives=_whole)
def nanoseconds(t: Array) -> Array:
    """A time or duration in ns."""
    sec, nanosec = (pc.cast(part, arrays.int64()) for part in stamp_parts(t))
    return pc.add(pc.multiply(sec, SECOND_NS), nanosec)


@function(INTEGER, gives=STAMP_TYPE)
def time_from_ns(refuse: Refuse, n: Array) -> Array:
    """Nanoseconds since the epoch as `{seconds, nanoseconds}`; more seconds than 32 bits hold reject the row."""
    (n,) = numbers(refuse, n)
    absent = nulls(n)
    total = np.asarray(pc.fill_null(n, 0))
    sec, nanosec = np.divmod(total, SECOND_NS)
    over = (sec < _INT32[0]) | (sec > _INT32[1])
    if over.any():
        refuse(over, "overflow", lambda i: f"{total[i]} ns are more seconds than 32 bits hold")
    children = [
        arrays.array(np.where(over, 0, sec).astype(np.int32)),
        arrays.array(nanosec.astype(np.uint32)),
    ]
    mask = None if absent is None else arrays.array(absent)
    return arrays.StructArray.from_arrays(children, fields=list(STAMP_TYPE), mask=mask)
