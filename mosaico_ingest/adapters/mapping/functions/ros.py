"""Functions for ROS conventions: headers, covariances, image formats, time stamps, rotations and point clouds."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mosaico_ingest.adapters.mapping.columns import (
    SECOND_NS,
    Array,
    Axis,
    DataType,
    ExprType,
    Mask,
    arrays,
    field_of,
    fixed_list,
    is_number,
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
    TEXT_LITERAL,
    RejectRows,
    function,
    set_null,
    struct_with,
)

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
    values = np.asarray(nanosec)
    over = (values >= SECOND_NS) | (values < 0)
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
    empty = _is_zero(pc.binary_length(frame))
    if empty.any():
        for part in stamp_parts(stamp):
            empty &= _is_zero(part)
    return empty


def _is_zero(values: Array) -> Mask:
    """Return which integers are zero or null."""
    return np.asarray(pc.fill_null(values, 0) if values.null_count else values) == 0


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


_NUMBERS = ("height", "width", "is_bigendian", "point_step", "row_step")
_FIELDS: dict[str, Any] = {
    **dict.fromkeys(_NUMBERS, pt.is_primitive),
    "fields": pt.is_list,
    "data": pt.is_binary,
}
_CLOUD = struct_with("a sensor_msgs/PointCloud2", _FIELDS)
_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_PACKED_BYTES = 4
Numbers: TypeAlias = "NDArray[Any]"
Convert: TypeAlias = "Callable[[Numbers], Numbers]"


class _InvalidCloud(Exception):  # noqa: N818 - a condition of one message, turned into a rejected row
    """A message contradicts itself, or a value does not fit the column."""


class _Clouds:
    """The fields of a batch of clouds as numpy arrays."""

    def __init__(self, cloud: Array) -> None:
        columns = {name: _as_numpy(field_of(cloud, name)) for name in _NUMBERS}
        self.heights, self.widths = columns["height"].astype(np.int64), columns["width"].astype(np.int64)
        self.steps, self.row_steps = columns["point_step"].astype(int), columns["row_step"].astype(int)
        self.big_endian = columns["is_bigendian"].astype(bool)
        data = field_of(cloud, "data").fill_null(b"")
        offsets = np.frombuffer(data.buffers()[1], np.int32)[data.offset : data.offset + len(data) + 1]
        self.starts, self.lengths = offsets[:-1].astype(np.int64), np.diff(offsets).astype(np.int64)
        self.octets = np.frombuffer(data.buffers()[2] or b"", np.uint8)
        entries, axis = open_list(field_of(cloud, "fields"))
        self.first, self.entry_counts = axis.offsets[:-1], axis.lengths
        self.names = field_of(entries, "name").to_pylist()
        columns_of_entries = (_as_numpy(field_of(entries, name)) for name in ("offset", "datatype", "count"))
        self.offsets, self.datatypes, self.counts = columns_of_entries

    def is_contiguous(self) -> bool:
        """Return whether all rows have the layout of the first, without padding, so that their points are contiguous."""
        per_row = (self.steps, self.big_endian, self.entry_counts)
        if any((column != column[:1]).any() for column in per_row) or not self.steps.all():
            return False
        entries = int(self.entry_counts[0])
        per_entry = (np.asarray(self.names, object), self.offsets, self.datatypes, self.counts)
        tables = [column.reshape(-1, entries) for column in per_entry] if entries else []
        needed = self.heights.astype(np.float64) * self.widths * self.steps  # floats do not wrap around
        return all((table == table[0]).all() for table in tables) and bool((self.lengths == needed).all())

    def block(self) -> Numbers:
        """Return the points of contiguous rows, shape (all points, step)."""
        start, end = int(self.starts[0]), int(self.starts[-1] + self.lengths[-1])
        return self.octets[start:end].reshape(-1, int(self.steps[0]))

    def points(self, row: int) -> Numbers:
        """Return the points of one row without the padding of its lines, shape (points, step)."""
        height, width, step = int(self.heights[row]), int(self.widths[row]), int(self.steps[row])
        start, length, line = int(self.starts[row]), int(self.lengths[row]), int(self.row_steps[row])
        if not height * width:
            return np.empty((0, step), np.uint8)
        if length == height * width * step or height == 1:
            line = width * step  # Some drivers leave row_step at zero if the lines have no padding.
        if not step or line < width * step or length < height * line:
            raise _InvalidCloud(
                f"{height} x {width} points of {step} bytes, row_step {line}, do not fit {length} bytes of data"
            )
        lines = self.octets[start : start + height * line].reshape(height, line)
        return lines[:, : width * step].reshape(-1, step)

    def locate(self, row: int, name: str) -> tuple[int, np.dtype[Any]] | None:
        """Return the offset and type of a field within a point, None if the cloud has no such field."""
        entries = range(int(self.first[row]), int(self.first[row] + self.entry_counts[row]))
        entry = next((entry for entry in entries if self.names[entry] == name), None)
        if entry is None:
            return None
        datatype, offset, count = (int(a[entry]) for a in (self.datatypes, self.offsets, self.counts))
        if datatype not in _DATATYPES:
            raise _InvalidCloud(f"field {name} has the unknown datatype {datatype}")
        dtype = np.dtype(_DATATYPES[datatype]).newbyteorder(">" if self.big_endian[row] else "<")
        if count > 1:
            raise _InvalidCloud(f"field {name} has {count} values per point")
        if offset + dtype.itemsize > self.steps[row] and self.heights[row] and self.widths[row]:
            raise _InvalidCloud(f"field {name} ends at byte {offset + dtype.itemsize} of {self.steps[row]}")
        return offset, dtype


def _as_numpy(column: Array) -> Numbers:
    """Return a column as numpy numbers or booleans, with zero for null."""
    return np.asarray(column.fill_null(arrays.scalar(0).cast(column.type)) if column.null_count else column)


def _read(points: Numbers, location: tuple[int, np.dtype[Any]]) -> Numbers:
    """Return one field of every point as a strided view."""
    offset, dtype = location
    if not len(points):
        return np.empty(0, dtype)
    contiguous = np.ascontiguousarray(points)  # copies only lines with padding
    return np.ndarray((len(contiguous),), dtype, contiguous.data, offset, (contiguous.shape[1],))


def _cast_to(dtype: np.dtype[Any]) -> Convert:
    """Return a cast to `dtype` that rejects values an integer type cannot represent; floats are rounded."""

    def convert(values: Numbers) -> Numbers:
        if dtype.kind == "f":
            with np.errstate(over="ignore", invalid="ignore"):  # Signalling NaNs stay NaN.
                return values.astype(dtype)
        limits = np.iinfo(dtype)
        fits = (values >= limits.min) & (values <= limits.max) & (values == np.trunc(values))
        if not fits.all():
            raise _InvalidCloud(f"{values[~fits][0]} is not a {dtype}")
        return values.astype(dtype)

    return convert


def _bits(values: Numbers) -> Numbers:
    """Return the four bytes of each value as a float32, whatever type the cloud declares."""
    if values.dtype.itemsize != _PACKED_BYTES:
        raise _InvalidCloud(f"a packed color has 4 bytes, not {values.dtype.itemsize}")
    words = values.view(np.dtype(np.uint32).newbyteorder(values.dtype.byteorder))
    return words.astype(np.uint32).view(np.float32)


def _columns(refuse: RejectRows, cloud: Array, name: str, dtype: np.dtype[Any], convert: Convert) -> Array:
    clouds = _Clouds(cloud)
    lengths = np.zeros(len(cloud), np.int64)
    absent = np.zeros(len(cloud), bool)
    problems: dict[int, str] = {}
    parts: list[Numbers] = []
    if len(cloud) and clouds.is_contiguous():
        with suppress(_InvalidCloud):  # The loop below finds the row.
            location = clouds.locate(0, name)
            if location is None and clouds.entry_counts[0]:
                return arrays.nulls(len(cloud), _list_of(dtype))
            if location is not None:
                values = convert(_read(clouds.block(), location))
                offsets = np.append(0, np.cumsum(clouds.heights * clouds.widths))
                return variable_list(arrays.array(values), offsets, null_mask(cloud))
    for row in range(len(cloud)):
        try:
            location = clouds.locate(row, name)
            points = clouds.points(row)
            absent[row] = location is None and (len(points) > 0 or clouds.entry_counts[row] > 0)
            parts.append(convert(_read(points, location)) if location is not None else np.empty(0, dtype))
        except _InvalidCloud as error:
            problems[row] = str(error)
            parts.append(np.empty(0, dtype))
        lengths[row] = len(parts[-1])
    if problems:
        bad = np.isin(np.arange(len(cloud)), list(problems))
        absent |= bad
        refuse(bad, "point-cloud", lambda row: problems[row])
    flat = np.concatenate(parts) if parts else np.empty(0, dtype)
    missing = null_mask(cloud)
    absent = absent if missing is None else absent | missing
    return variable_list(arrays.array(flat.astype(dtype)), np.append(0, np.cumsum(lengths)), absent)


def _list_of(dtype: np.dtype[Any]) -> DataType:
    return arrays.list_(arrays.from_numpy_dtype(dtype))


@function(_CLOUD, TEXT_LITERAL, returns=_list_of(np.dtype(np.float32)))
def points_float32(refuse: RejectRows, cloud: Array, field: str) -> Array:
    """A field of every point of a PointCloud2 as float32; null if the cloud has no such field."""
    dtype = np.dtype(np.float32)
    return _columns(refuse, cloud, field, dtype, _cast_to(dtype))


@function(_CLOUD, TEXT_LITERAL, returns=_list_of(np.dtype(np.float64)))
def points_float64(refuse: RejectRows, cloud: Array, field: str) -> Array:
    """A field of every point of a PointCloud2 as float64; null if the cloud has no such field."""
    dtype = np.dtype(np.float64)
    return _columns(refuse, cloud, field, dtype, _cast_to(dtype))


@function(_CLOUD, TEXT_LITERAL, returns=_list_of(np.dtype(np.uint8)))
def points_uint8(refuse: RejectRows, cloud: Array, field: str) -> Array:
    """A field of every point as uint8; rejects rows with other values."""
    dtype = np.dtype(np.uint8)
    return _columns(refuse, cloud, field, dtype, _cast_to(dtype))


@function(_CLOUD, TEXT_LITERAL, returns=_list_of(np.dtype(np.uint16)))
def points_uint16(refuse: RejectRows, cloud: Array, field: str) -> Array:
    """A field of every point as uint16; rejects rows with other values."""
    dtype = np.dtype(np.uint16)
    return _columns(refuse, cloud, field, dtype, _cast_to(dtype))


@function(_CLOUD, TEXT_LITERAL, returns=_list_of(np.dtype(np.float32)))
def points_packed(refuse: RejectRows, cloud: Array, field: str) -> Array:
    """A packed color of every point: its four bytes as float32, as in PCL, also if the cloud declares uint32."""
    return _columns(refuse, cloud, field, np.dtype(np.float32), _bits)
