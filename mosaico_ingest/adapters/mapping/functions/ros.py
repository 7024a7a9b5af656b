"""Functions for ROS conventions: headers, covariances, image formats, time stamps and rotations."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from mosaico_ingest.adapters.mapping.columns import (
    SECOND_NS,
    Array,
    Axis,
    DataType,
    Mask,
    arrays,
    field_of,
    fixed_list,
    null_mask,
    open_list,
    pc,
    pt,
    true_mask,
    variable_list,
)
from mosaico_ingest.adapters.mapping.functions.lists import NUMBERS
from mosaico_ingest.adapters.mapping.functions.operators import float_result, integer_result, numbers
from mosaico_ingest.adapters.mapping.functions.registry import (
    FLOAT,
    INTEGER,
    TEXT,
    RejectRows,
    function,
    set_null,
    struct_with,
)
from mosaico_ingest.adapters.mapping.types import ExprType, is_number

STAMP_TYPE: DataType = arrays.struct(
    [
        arrays.field("seconds", arrays.int32(), nullable=False),
        arrays.field("nanoseconds", arrays.uint32(), nullable=False),
    ]
)
"""The ontology's type of `Time`, `Duration` and the `timestamp` of a header."""
STAMP = struct_with(
    "a time or duration",
    {"sec": pt.is_integer, "nanosec": pt.is_integer},
    {"seconds": pt.is_integer, "nanoseconds": pt.is_integer},
    {"seconds": pt.is_integer, "nanos": pt.is_integer},
    {"sec": pt.is_integer, "nsec": pt.is_integer},
)
"""The times of ROS, the ontology, `google.protobuf.Timestamp`, and Foxglove's JSON."""
_INT32 = (-(2**31), 2**31 - 1)


def stamp_parts(t: Array) -> tuple[Array, Array]:
    """Return the seconds and the nanoseconds of a time in any of the forms of `STAMP`."""
    names = {field.name for field in t.type}
    seconds = "sec" if "sec" in names else "seconds"
    nanoseconds = next(name for name in ("nanosec", "nsec", "nanos", "nanoseconds") if name in names)
    return field_of(t, seconds), field_of(t, nanoseconds)


def as_stamp(refuse: RejectRows, t: Array) -> Array:
    """Convert a time to the ontology's time, without copying fields of matching type."""
    sec, nanosec = stamp_parts(t)
    absent = null_mask(t)
    if sec.null_count or nanosec.null_count:
        sec, nanosec = _complete_parts(refuse, sec, nanosec, absent)
    over = true_mask(pc.greater_equal(nanosec, SECOND_NS))
    if nanosec.type != arrays.uint32():
        over |= true_mask(pc.less(nanosec, 0))
    if over.any():
        refuse(over, "nanosec", lambda i: f"nanosec is {nanosec[i]}, it must be below 1e9 and not negative")
        nanosec = set_null(nanosec, over)
    if sec.type != arrays.int32():
        sec = _in_int32(refuse, sec)
    children = [pc.cast(sec, arrays.int32()), pc.cast(nanosec, arrays.uint32())]
    mask = None if absent is None else arrays.array(absent)
    return arrays.StructArray.from_arrays(children, fields=list(STAMP_TYPE), mask=mask)


def _complete_parts(
    refuse: RejectRows, sec: Array, nanosec: Array, absent: Mask | None
) -> tuple[Array, Array]:
    """Reject times of which one part is null, and fill in zeros, which are invisible in absent times."""
    partial = np.asarray(pc.or_(sec.is_null(), nanosec.is_null()))
    if absent is not None:
        partial &= ~absent
    if partial.any():
        refuse(partial, "null", lambda _: "the time has no seconds or no nanoseconds")
    return pc.fill_null(sec, 0), pc.fill_null(nanosec, 0)


def _in_int32(refuse: RejectRows, sec: Array) -> Array:
    """Reject times whose seconds do not fit the ontology's time."""
    values = np.asarray(sec)
    bad = (values < _INT32[0]) | (values > _INT32[1])
    if bad.any():
        refuse(bad, "out-of-range", lambda i: f"{sec[i]} seconds do not fit int32")
        return set_null(sec, bad)
    return sec


@function(STAMP, returns=STAMP_TYPE)
def ros_time(refuse: RejectRows, t: Array) -> Array:
    """A time such as `{sec, nanosec}` as `{seconds, nanoseconds}`; rejects rows with nanosec of 1e9 or more."""
    return as_stamp(refuse, t)


@function(STAMP, returns=arrays.float64())
def seconds(t: Array) -> Array:
    """A time or duration in s."""
    sec, nanosec = stamp_parts(t)
    fraction = pc.multiply(pc.cast(nanosec, arrays.float64()), 1e-9)
    return pc.add(pc.cast(sec, arrays.float64()), fraction)


def _integer(_: ExprType) -> ExprType:
    return integer_result()


@function(STAMP, returns=_integer)
def nanoseconds(t: Array) -> Array:
    """A time or duration in ns."""
    sec, nanosec = (pc.cast(part, arrays.int64()) for part in stamp_parts(t))
    return pc.add(pc.multiply(sec, SECOND_NS), nanosec)


@function(INTEGER, returns=STAMP_TYPE)
def time_from_ns(refuse: RejectRows, n: Array) -> Array:
    """Nanoseconds since the epoch as `{seconds, nanoseconds}`; rejects rows whose seconds exceed 32 bits."""
    (n,) = numbers(refuse, n)
    absent = null_mask(n)
    total = np.asarray(pc.fill_null(n, 0))
    sec, nanosec = np.divmod(total, SECOND_NS)
    over = (sec < _INT32[0]) | (sec > _INT32[1])
    if over.any():
        refuse(over, "overflow", lambda i: f"{total[i]} ns exceed the range of 32-bit seconds")
    children = [
        arrays.array(np.where(over, 0, sec).astype(np.int32)),
        arrays.array(nanosec.astype(np.uint32)),
    ]
    mask = None if absent is None else arrays.array(absent)
    return arrays.StructArray.from_arrays(children, fields=list(STAMP_TYPE), mask=mask)


_AXES = ("x", "y", "z", "w")
QUATERNION_TYPE: DataType = arrays.struct([(axis, arrays.float64()) for axis in _AXES])
_QUATERNION = struct_with("a quaternion {x, y, z, w}", dict.fromkeys(_AXES, is_number))


def _halves(*angles: Array) -> tuple[NDArray[np.bool_], list[NDArray[np.float64]]]:
    """Return where an angle is null, and half of each angle, with NaN for null."""
    plain = [np.asarray(pc.fill_null(angle, np.nan), np.float64) for angle in angles]
    absent = np.zeros(np.broadcast_shapes(*(p.shape for p in plain)), bool)
    for angle in angles:
        absent |= np.asarray(pc.is_null(angle), bool)
    return absent, [np.broadcast_to(p, absent.shape) / 2 for p in plain]


def _sin_cos(half: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    with np.errstate(invalid="ignore"):  # Sine and cosine of an infinite angle are NaN.
        return np.sin(half), np.cos(half)


def _quaternions(parts: tuple[NDArray[np.float64], ...], absent: NDArray[np.bool_]) -> Array:
    children = [arrays.array(np.ascontiguousarray(part)) for part in parts]
    mask = arrays.array(absent) if absent.any() else None
    return arrays.StructArray.from_arrays(children, fields=list(QUATERNION_TYPE), mask=mask)


@function(FLOAT, FLOAT, FLOAT, returns=QUATERNION_TYPE)
def quaternion_from_rpy(roll: Array, pitch: Array, yaw: Array) -> Array:
    """Rotation about the fixed axes x, then y, then z."""
    absent, (r, p, y) = _halves(roll, pitch, yaw)
    (sr, cr), (sp, cp), (sy, cy) = (_sin_cos(half) for half in (r, p, y))
    return _quaternions(
        (
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ),
        absent,
    )


@function(FLOAT, returns=QUATERNION_TYPE)
def quaternion_from_yaw(yaw: Array) -> Array:
    """Rotation in the plane, about z."""
    absent, (y,) = _halves(yaw)
    zero = np.zeros(len(y))
    return _quaternions((zero, zero, *_sin_cos(y)), absent)


@function(_QUATERNION, returns=arrays.float64())
def yaw(q: Array) -> Array:
    """Heading of a quaternion: its rotation about z in rad."""
    x, y, z, w = (pc.cast(field_of(q, axis), arrays.float64()) for axis in _AXES)
    sine = pc.multiply(pc.add(pc.multiply(w, z), pc.multiply(x, y)), 2.0)
    cosine = pc.subtract(1.0, pc.multiply(pc.add(pc.multiply(y, y), pc.multiply(z, z)), 2.0))
    return pc.atan2(sine, cosine)


HEADER_TYPE: DataType = arrays.struct(
    [("timestamp", STAMP_TYPE), ("frame_id", arrays.string()), ("sample_counter", arrays.uint64())]
)


def _is_stamp(type_: DataType) -> bool:
    return STAMP.accepts(ExprType(type_))


HEADER = struct_with("a std_msgs/Header", {"stamp": _is_stamp, "frame_id": pt.is_string})
_CODECS = {name: name for name in ("png", "jpeg", "jpg", "tiff", "h264", "hevc", "raw")} | {"h265": "hevc"}


def as_header(refuse: RejectRows, h: Array, *, collapse: bool = True) -> Array:
    """Convert a `std_msgs/Header` to the ontology's header; `collapse` makes an empty header null."""
    stamp, frame = field_of(h, "stamp"), field_of(h, "frame_id")
    absent = null_mask(h)
    if collapse:
        empty = _is_empty(stamp, frame)
        absent = empty if absent is None else absent | empty
    counter = arrays.nulls(len(h), arrays.uint64())
    if h.type.get_field_index("seq") >= 0:
        counter = pc.cast(field_of(h, "seq"), arrays.uint64())
    mask = arrays.array(absent) if absent is not None and absent.any() else None
    children = [as_stamp(refuse, stamp), frame, counter]
    return arrays.StructArray.from_arrays(children, fields=list(HEADER_TYPE), mask=mask)


def _is_empty(stamp: Array, frame: Array) -> Mask:
    unnamed = true_mask(pc.equal(pc.binary_length(frame), 0), null=True)
    if not unnamed.any():
        return unnamed
    zero = [true_mask(pc.equal(part, 0), null=True) for part in stamp_parts(stamp)]
    return unnamed & zero[0] & zero[1]


@function(HEADER, returns=HEADER_TYPE)
def ros_header(refuse: RejectRows, h: Array) -> Array:
    """A std_msgs/Header as the ontology's header, with ROS 1 `seq` as `sample_counter`; null if frame_id is empty and the stamp zero."""
    return as_header(refuse, h)


def _same(expr_type: ExprType) -> ExprType:
    return expr_type


@function(NUMBERS, returns=_same)
def covariance(c: Array) -> Array:
    """c, or null unless at least one element is > 0."""
    elements, axis = open_list(c)
    absent = ~_any_positive(elements, axis)
    if axis.null is not None:
        absent |= axis.null
    if not absent.any():
        return c
    if axis.size is not None:
        return fixed_list(elements, axis.size, absent, len(c))
    return variable_list(elements, axis.offsets, absent)


def _any_positive(elements: Array, axis: Axis) -> Mask:
    """Return which lists have an element > 0."""
    rows = len(axis.offsets) - 1
    positive = np.zeros(rows, bool)
    if axis.size is None or elements.null_count:
        positive[axis.parents[true_mask(pc.greater(elements, 0))]] = True
        return positive
    for column in np.asarray(elements).reshape(rows, axis.size).T:
        positive |= column > 0
        if positive.all():
            break
    return positive


@function(FLOAT, returns=float_result)
def variance(x: Array) -> Array:
    """x, or null unless it is > 0."""
    return pc.if_else(pc.greater(x, 0.0), x, arrays.scalar(None, arrays.float64()))


@function(TEXT, returns=arrays.string())
def compressed_format(s: Array) -> Array:
    """The codec that a CompressedImage's `format` names: png, jpeg, jpg, tiff, h264 or hevc; raw if it names none of these."""
    texts = s.dictionary_encode() if not pt.is_null(s.type) else s
    names = arrays.array([_codec(value) for value in texts.dictionary.to_pylist()], arrays.string())
    return names.take(texts.indices)


def _codec(text: str) -> str:
    """Return the codec in a format text, such as `bgr8; jpeg compressed bgr8` or `16UC1; compressedDepth png`.

    An empty text, and `compressedDepth` without a codec, mean PNG, the default of the image transports.
    """
    words = [word for word in re.split(r"[;,\s]+", text.lower()) if word]
    codecs = [_CODECS[word] for word in words if word in _CODECS]
    if codecs:
        return codecs[0]
    return "png" if not words or words[-1] == "compresseddepth" else "raw"
