"""Fields of point clouds, for all points of all messages."""

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
from mosaico_ingest.adapters.mapping.functions.registry import (
    TEXT_LITERAL,
    RejectRows,
    function,
    struct_with,
)

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


class _Misfit(Exception):  # noqa: N818 - a condition of one message, turned into a rejected row
    """A message contradicts itself, or a value has no place in the ontology."""


class _Clouds:
    """The columns of a batch of clouds as numpy arrays."""

    def __init__(self, cloud: Array) -> None:
        columns = {name: _plain(field_of(cloud, name)) for name in _NUMBERS}
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
        expr_types = (_plain(field_of(entries, name)) for name in ("offset", "datatype", "count"))
        self.offsets, self.datatypes, self.counts = expr_types

    def alike(self) -> bool:
        """Whether all rows are laid out like the first, without padding, so that their bytes are one block."""
        per_row = (self.steps, self.big_endian, self.entry_counts)
        if any((column != column[:1]).any() for column in per_row) or not self.steps.all():
            return False
        entries = int(self.entry_counts[0])
        per_entry = (np.asarray(self.names, object), self.offsets, self.datatypes, self.counts)
        tables = [column.reshape(-1, entries) for column in per_entry] if entries else []
        needed = self.heights.astype(np.float64) * self.widths * self.steps  # cannot wrap around
        return all((table == table[0]).all() for table in tables) and bool((self.lengths == needed).all())

    def block(self) -> Numbers:
        """Return the points of rows that are alike, shape (all points, step)."""
        start, end = int(self.starts[0]), int(self.starts[-1] + self.lengths[-1])
        return self.octets[start:end].reshape(-1, int(self.steps[0]))

    def points(self, row: int) -> Numbers:
        """Return the points of one row, shape (points, step), without the padding behind each line."""
        height, width, step = int(self.heights[row]), int(self.widths[row]), int(self.steps[row])
        start, length, line = int(self.starts[row]), int(self.lengths[row]), int(self.row_steps[row])
        if not height * width:
            return np.empty((0, step), np.uint8)
        if length == height * width * step or height == 1:
            line = width * step  # some drivers leave row_step at zero where nothing is padded
        if not step or line < width * step or length < height * line:
            raise _Misfit(
                f"{height} x {width} points of {step} bytes, row_step {line}, do not fit {length} bytes of data"
            )
        lines = self.octets[start : start + height * line].reshape(height, line)
        return lines[:, : width * step].reshape(-1, step)

    def place(self, row: int, name: str) -> tuple[int, np.dtype[Any]] | None:
        """Return where a field lies in a point and its type there; None where the cloud has none of that name."""
        entries = range(int(self.first[row]), int(self.first[row] + self.entry_counts[row]))
        entry = next((entry for entry in entries if self.names[entry] == name), None)
        if entry is None:
            return None
        datatype, offset, count = (int(a[entry]) for a in (self.datatypes, self.offsets, self.counts))
        if datatype not in _DATATYPES:
            raise _Misfit(f"field {name} has the unknown datatype {datatype}")
        dtype = np.dtype(_DATATYPES[datatype]).newbyteorder(">" if self.big_endian[row] else "<")
        if count > 1:
            raise _Misfit(f"field {name} has {count} values a point")
        if offset + dtype.itemsize > self.steps[row] and self.heights[row] and self.widths[row]:
            raise _Misfit(f"field {name} ends at byte {offset + dtype.itemsize} of {self.steps[row]}")
        return offset, dtype


def _plain(column: Array) -> Numbers:
    """Return numbers or booleans, zero where there is none."""
    return np.asarray(column.fill_null(arrays.scalar(0).cast(column.type)) if column.null_count else column)


def _read(points: Numbers, place: tuple[int, np.dtype[Any]]) -> Numbers:
    """Return one field of every point, unaligned and in place."""
    offset, dtype = place
    if not len(points):
        return np.empty(0, dtype)
    whole = np.ascontiguousarray(points)  # a copy only where lines of one point are padded
    return np.ndarray((len(whole),), dtype, whole.data, offset, (whole.shape[1],))


def _cast_to(dtype: np.dtype[Any]) -> Convert:
    """Return a cast that refuses what an integer type cannot hold; floats take the nearest value."""

    def convert(values: Numbers) -> Numbers:
        if dtype.kind == "f":
            with np.errstate(over="ignore", invalid="ignore"):  # signalling NaNs stay NaN
                return values.astype(dtype)
        limits = np.iinfo(dtype)
        fits = (values >= limits.min) & (values <= limits.max) & (values == np.trunc(values))
        if not fits.all():
            raise _Misfit(f"{values[~fits][0]} is no {dtype}")
        return values.astype(dtype)

    return convert


def _bits(values: Numbers) -> Numbers:
    """Return the four bytes of each value as a float32, whichever number type they were declared as."""
    if values.dtype.itemsize != _PACKED_BYTES:
        raise _Misfit(f"a packed colour has 4 bytes, not {values.dtype.itemsize}")
    words = values.view(np.dtype(np.uint32).newbyteorder(values.dtype.byteorder))
    return words.astype(np.uint32).view(np.float32)


def _columns(refuse: RejectRows, cloud: Array, name: str, dtype: np.dtype[Any], convert: Convert) -> Array:
    clouds = _Clouds(cloud)
    lengths = np.zeros(len(cloud), np.int64)
    absent = np.zeros(len(cloud), bool)
    misfits: dict[int, str] = {}
    parts: list[Numbers] = []
    if len(cloud) and clouds.alike():
        with suppress(_Misfit):  # which row it is comes out one by one
            place = clouds.place(0, name)
            if place is None and clouds.entry_counts[0]:
                return arrays.nulls(len(cloud), _list_of(dtype))
            if place is not None:
                values = convert(_read(clouds.block(), place))
                offsets = np.append(0, np.cumsum(clouds.heights * clouds.widths))
                return variable_list(arrays.array(values), offsets, null_mask(cloud))
    for row in range(len(cloud)):
        try:
            place = clouds.place(row, name)
            points = clouds.points(row)
            absent[row] = place is None and (len(points) > 0 or clouds.entry_counts[row] > 0)
            parts.append(convert(_read(points, place)) if place is not None else np.empty(0, dtype))
        except _Misfit as misfit:
            misfits[row] = str(misfit)
            parts.append(np.empty(0, dtype))
        lengths[row] = len(parts[-1])
    if misfits:
        bad = np.isin(np.arange(len(cloud)), list(misfits))
        absent |= bad
        refuse(bad, "point-cloud", lambda row: misfits[row])
    flat = np.concatenate(parts) if parts else np.empty(0, dtype)
    missing = null_mask(cloud)
    absent = absent if missing is None else absent | missing
    return variable_list(arrays.array(flat.astype(dtype)), np.append(0, np.cumsum(lengths)), absent)


def _list_of(dtype: np.dtype[Any]) -> DataType:
    return arrays.list_(arrays.from_numpy_dtype(dtype))


@function(_CLOUD, TEXT_LITERAL, returns=_list_of(np.dtype(np.float32)))
def points_float32(refuse: RejectRows, cloud: Array, field: str) -> Array:
    """A field of every point of a PointCloud2 as float32; null where the cloud has no such field."""
    dtype = np.dtype(np.float32)
    return _columns(refuse, cloud, field, dtype, _cast_to(dtype))


@function(_CLOUD, TEXT_LITERAL, returns=_list_of(np.dtype(np.float64)))
def points_float64(refuse: RejectRows, cloud: Array, field: str) -> Array:
    """The same as float64."""
    dtype = np.dtype(np.float64)
    return _columns(refuse, cloud, field, dtype, _cast_to(dtype))


@function(_CLOUD, TEXT_LITERAL, returns=_list_of(np.dtype(np.uint8)))
def points_uint8(refuse: RejectRows, cloud: Array, field: str) -> Array:
    """The same as uint8; a value that is none rejects the row."""
    dtype = np.dtype(np.uint8)
    return _columns(refuse, cloud, field, dtype, _cast_to(dtype))


@function(_CLOUD, TEXT_LITERAL, returns=_list_of(np.dtype(np.uint16)))
def points_uint16(refuse: RejectRows, cloud: Array, field: str) -> Array:
    """The same as uint16; a value that is none rejects the row."""
    dtype = np.dtype(np.uint16)
    return _columns(refuse, cloud, field, dtype, _cast_to(dtype))


@function(_CLOUD, TEXT_LITERAL, returns=_list_of(np.dtype(np.float32)))
def points_packed(refuse: RejectRows, cloud: Array, field: str) -> Array:
    """A packed colour of every point: its four bytes as float32, the way PCL stores rgb, also where it says uint32."""
    return _columns(refuse, cloud, field, np.dtype(np.float32), _bits)
