"""Points of point clouds, laser scans and radars, and pictures of them from above."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.errors import ViewError
from mosaico_ingest.images import Pixels, color_map, gray

_NUMPY_TYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
"""The types of point fields, from code 1 (INT8) to 8 (FLOAT64)."""
_PERCENTILES = (0.5, 99.5)
_BACKGROUND = 18
_GRID = 52
_MARGIN = 0.04
"""Share of the extent that is added on each side."""
_MIN_EXTENT_M = 1.0
_LARGE_PICTURE = 400
_FEW_POINTS = 2_000
_UNKNOWN = 128
_LARGEST_PIXELS = 1 << 26


class Points(Struct, frozen=True):
    """Finite points in the sensor's frame, in m."""

    xyz: npt.NDArray[np.float32]
    """Coordinates, of shape (n, 3)."""
    values: npt.NDArray[np.float32] | None = None
    """The intensity of each point, if the sensor reports it."""


def has_points(schema: pa.Schema) -> bool:
    """Return whether the rows of a topic with these columns contain points."""
    names = set(schema.names)
    if {"fields", "point_step", "data"} <= names or {"ranges", "angle_min", "angle_increment"} <= names:
        return True
    if {"x", "y", "z"} <= names:
        return all(pa.types.is_list(schema.field(name).type) for name in "xyz")
    return any(name in names and _is_list_of_points(schema.field(name).type) for name in ("points", "cells"))


def has_grid(schema: pa.Schema) -> bool:
    """Return whether the rows of a topic with these columns are occupancy grids."""
    if not {"info", "data"} <= set(schema.names) or not pa.types.is_list(schema.field("data").type):
        return False
    info = schema.field("info").type
    return pa.types.is_struct(info) and {"width", "height"} <= {field.name for field in info}


def row_points(row: Mapping[str, Any]) -> Points:
    """Return the finite points of a row.

    Raises:
        ViewError: The row contains no points, or its layout is invalid.
    """
    if "point_step" in row:
        return _packed_points(row)
    if "angle_increment" in row:
        return _beam_points(row)
    if isinstance(row.get("x"), Sequence):
        return _finite([row["x"], row["y"], row["z"]], row.get("intensity"))
    for name in ("points", "cells"):
        if name in row:
            points = row[name] or []
            return _finite([[point[axis] for point in points] for axis in "xyz"], None)
    raise ViewError("the row contains no points")


def from_above(points: Points, *, size: int = 800) -> Pixels:
    """Return the points from above, to scale: x points to the right, y points up, colors show the height.

    The picture has at most `size` x `size` pixels. The grid has lines every 1, 2, 5, 10, … m; a few outliers are cropped.
    """
    xy, heights = points.xyz[:, :2].astype(np.float64), points.xyz[:, 2]
    if not len(xy):
        return np.full((size, size, 3), _BACKGROUND, np.uint8)
    low, high = np.percentile(xy, _PERCENTILES, axis=0)
    if (
        np.minimum(np.abs(low), np.abs(high)) <= high - low
    ).all():  # the sensor is near: it belongs into the picture
        low, high = np.minimum(low, 0), np.maximum(high, 0)
    extent = np.maximum(high - low, _MIN_EXTENT_M)
    low, extent = low - _MARGIN * extent, (1 + 2 * _MARGIN) * extent
    scale = (size - 1) / float(extent.max())
    width, height = (int(extent[axis] * scale) + 1 for axis in range(2))
    pixels = np.full((height, width, 3), _BACKGROUND, np.uint8)
    step = grid_step(float(extent.max()))
    for axis, length in ((0, width), (1, height)):
        lines = np.arange(math.ceil(low[axis] / step), math.floor((low[axis] + extent[axis]) / step) + 1)
        at = np.clip(((lines * step - low[axis]) * scale).astype(int), 0, length - 1)
        if axis == 0:
            pixels[:, at] = _GRID
        else:
            pixels[height - 1 - at, :] = _GRID
    at = np.floor((xy - low) * scale).astype(np.int64)
    inside = (at >= 0).all(axis=1) & (at[:, 0] < width) & (at[:, 1] < height)
    order = np.argsort(heights[inside], kind="stable")  # higher points cover lower ones
    columns, rows = at[inside][order].T
    is_flat = float(np.ptp(heights)) == 0
    shades = np.ones(len(order)) if is_flat else heights[inside][order] - float(heights.min()) + 1
    colors = np.full((len(order), 3), 230, np.uint8) if is_flat else color_map(shades[np.newaxis])[0]
    radius = 1 if size >= _LARGE_PICTURE else 0  # single pixels are hard to see in a large picture
    radius += 2 if len(order) < _FEW_POINTS else 0
    for offset_y in range(radius + 1):
        for offset_x in range(radius + 1):
            pixels[
                np.clip(height - 1 - rows + offset_y, 0, height - 1),
                np.clip(columns + offset_x, 0, width - 1),
            ] = colors
    return pixels


def grid_step(extent_m: float) -> float:
    """Return the distance of grid lines for an extent: 1, 2 or 5 times a power of ten, about ten lines."""
    power = 10.0 ** math.floor(math.log10(extent_m / 10))
    return next(power * factor for factor in (1, 2, 5, 10) if power * factor >= extent_m / 10)


def grid_pixels(row: Mapping[str, Any]) -> Pixels:
    """Return an occupancy grid: free cells are white, occupied cells black, unknown cells gray; y points up.

    Raises:
        ViewError: The number of cells differs from width times height.
    """
    width, height = int(row["info"]["width"]), int(row["info"]["height"])
    cells = np.asarray(row["data"] or [], np.int16)
    if not 0 < width * height <= _LARGEST_PIXELS or cells.size != width * height:
        raise ViewError(f"the grid has {width} x {height} cells, but {cells.size} values")
    shades = np.where(cells < 0, _UNKNOWN, 255 - np.clip(cells, 0, 100) * 255 // 100).astype(np.uint8)
    return gray(np.flipud(shades.reshape(height, width)))


def _is_list_of_points(kind: pa.DataType) -> bool:
    if not pa.types.is_list(kind) or not pa.types.is_struct(kind.value_type):
        return False
    return {"x", "y", "z"} <= {field.name for field in kind.value_type}


def _packed_points(row: Mapping[str, Any]) -> Points:
    """Return the points of a buffer with a layout, as in `sensor_msgs/PointCloud2`."""
    layout = {str(field["name"]): field for field in row["fields"] or ()}
    missing = [axis for axis in "xyz" if axis not in layout]
    if missing:
        raise ViewError(f"the points have no field {missing[0]!r}; they have {', '.join(layout) or 'none'}")
    width, height, step = int(row["width"]), int(row["height"]), int(row["point_step"])
    data = np.frombuffer(row["data"] or b"", np.uint8)
    row_step = int(row["row_step"]) or width * step
    if width * height == 0:
        return Points(np.empty((0, 3), np.float32))
    if step <= 0 or row_step < width * step or data.size < row_step * (height - 1) + width * step:
        raise ViewError(
            f"{width} x {height} points of {step} bytes do not fit into {data.size} bytes with rows of {row_step}"
        )
    order = ">" if row["is_bigendian"] else "<"
    names = [name for name in ("x", "y", "z", "intensity") if name in layout]
    kinds = [f"{order}{_NUMPY_TYPES[int(layout[name]['datatype']) - 1]}" for name in names]
    offsets = [int(layout[name]["offset"]) for name in names]
    if any(at + np.dtype(kind).itemsize > step for at, kind in zip(offsets, kinds, strict=True)):
        raise ViewError(f"a field ends after the {step} bytes of a point")
    point = np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": step})
    rows = [np.frombuffer(row["data"], point, count=width, offset=line * row_step) for line in range(height)]
    points = rows[0] if height == 1 else np.concatenate(rows)
    return _finite([points[axis] for axis in "xyz"], points["intensity"] if "intensity" in layout else None)


def _beam_points(row: Mapping[str, Any]) -> Points:
    """Return the points of a laser scan; of several echoes the first counts."""
    echoes = [beam.get("echoes") if isinstance(beam, dict) else beam for beam in row["ranges"] or ()]
    firsts = [(echo[0] if echo else math.nan) if isinstance(echo, Sequence) else echo for echo in echoes]
    ranges = np.asarray([math.nan if value is None else value for value in firsts], np.float32)
    valid = (ranges >= row["range_min"]) & (ranges <= row["range_max"])
    angles = row["angle_min"] + np.arange(len(ranges)) * row["angle_increment"]
    values = row.get("intensities")
    usable = (
        isinstance(values, Sequence)
        and len(values) == len(ranges)
        and not isinstance(values[0], Sequence | dict)
    )
    intensities = np.asarray(values, np.float32)[valid] if usable and values is not None else None
    flat = np.zeros(int(valid.sum()), np.float32)
    return _finite(
        [ranges[valid] * np.cos(angles[valid]), ranges[valid] * np.sin(angles[valid]), flat], intensities
    )


def _finite(axes: Sequence[Any], values: Any) -> Points:  # noqa: ANN401 - lists or arrays
    """Return the points whose coordinates are finite."""
    lengths = {len(axis) for axis in axes}
    if len(lengths) > 1:
        raise ViewError(f"the coordinates have different lengths: {', '.join(map(str, sorted(lengths)))}")
    xyz = np.stack([np.asarray(axis, np.float32) for axis in axes], axis=1)
    valid = np.isfinite(xyz).all(axis=1)
    matches = values is not None and len(values) == len(xyz)
    return Points(xyz[valid], np.asarray(values, np.float32)[valid] if matches else None)
