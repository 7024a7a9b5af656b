"""This file packs columns of points into PointCloud2 messages: unordered (height 1), little-endian."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mosaico_ingest.adapters.mapping.arrow import Array, arrays
from mosaico_ingest.adapters.mapping.columns import open_list
from mosaico_ingest.frozen import frozen

__all__ = ["CLOUD_FUNCTIONS", "CloudField", "make_clouds"]

CLOUD_FUNCTIONS: Mapping[str, tuple[str, int]] = {
    "points_float32": ("<f4", 7),
    "points_float64": ("<f8", 8),
    "points_uint8": ("u1", 2),
    "points_uint16": ("<u2", 4),
    "points_packed": ("<f4", 7),
}
"""What a function reads from a cloud: numpy's name of it, and the number PointField has for it."""


@frozen
class CloudField:
    """A field of the points of every row."""

    name: str
    function: str
    values: Array
    """Lists, one element a point; null where the cloud has no such field."""


def make_clouds(fields: Sequence[CloudField], rows: int) -> Array:
    """Return what a cloud is made of, without its header, one a row."""
    opened = [(field, *open_list(field.values)) for field in fields]
    flat = [np.asarray(elements).astype(CLOUD_FUNCTIONS[field.function][0]) for field, elements, _ in opened]
    made: list[dict[str, Any]] = []
    for row in range(rows):
        there = [
            (field, values[axis.offsets[row] : axis.offsets[row + 1]])
            for (field, _, axis), values in zip(opened, flat, strict=True)
            if axis.null is None or not axis.null[row]
        ]
        made.append(_cloud(there))
    return arrays.array(made, _CLOUD)


def _cloud(fields: Sequence[tuple[CloudField, Any]]) -> dict[str, Any]:
    points = max((len(values) for _, values in fields), default=0)
    layout: Any = np.dtype([(field.name, CLOUD_FUNCTIONS[field.function][0]) for field, _ in fields])
    packed: Any = np.zeros(points, layout)
    for field, values in fields:
        packed[field.name][: len(values)] = values
    entries = [
        {
            "name": field.name,
            "offset": int(layout.fields[field.name][1]),
            "datatype": CLOUD_FUNCTIONS[field.function][1],
            "count": 1,
        }
        for field, _ in fields
    ]
    step = layout.itemsize
    return {
        "height": 1,
        "width": points,
        "fields": entries,
        "is_bigendian": False,
        "point_step": step,
        "row_step": step * points,
        "data": packed.tobytes(),
        "is_dense": all(bool(np.isfinite(values).all()) for _, values in fields),
    }


_FIELD = arrays.struct(
    [
        ("name", arrays.string()),
        ("offset", arrays.uint32()),
        ("datatype", arrays.uint8()),
        ("count", arrays.uint32()),
    ]
)
_CLOUD = arrays.struct(
    [
        ("height", arrays.uint32()),
        ("width", arrays.uint32()),
        ("fields", arrays.list_(_FIELD)),
        ("is_bigendian", arrays.bool_()),
        ("point_step", arrays.uint32()),
        ("row_step", arrays.uint32()),
        ("data", arrays.binary()),
        ("is_dense", arrays.bool_()),
    ]
)
