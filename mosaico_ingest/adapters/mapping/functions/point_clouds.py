"""Fields of point clouds: one list per message, with one element per point."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mosaico_ingest.adapters.mapping.columns import (
    Array,
    DataType,
    arrays,
    field_of,
    null_mask,
    open_list,
    pt,
    variable_list,
)
from mosaico_ingest.adapters.mapping.functions.registry import TEXT_LITERAL, RejectRows, function, struct_with

__all__: list[str] = []

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
