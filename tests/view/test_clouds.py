"""Points of rows, and pictures from above: right side up, to scale, and colored by height."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import ViewError
from mosaico_ingest.ontology.registry import builtin_type
from mosaico_ingest.view.pictures import (
    Points,
    from_above,
    grid_pixels,
    grid_step,
    has_grid,
    has_pictures,
    has_points,
    row_picture,
    row_points,
)
from mosaico_ingest.view.rows import nearest_row

XYZ = [(1.0, 2.0, 3.0), (math.nan, 0.0, 0.0), (4.0, -5.0, 6.0)]
CODES = {"f4": 7, "f8": 8, "u2": 4}


def packed(order: str = "<", *, padding: int = 0, height: int = 1) -> dict[str, Any]:
    point = np.dtype(
        {
            "names": ["x", "y", "z", "intensity"],
            "formats": [f"{order}f4", f"{order}f4", f"{order}f8", f"{order}u2"],
            "offsets": [0, 8, 16, 24],
            "itemsize": 28,
        }
    )
    points = np.zeros(len(XYZ), point)
    for axis, values in zip("xyz", zip(*XYZ, strict=True), strict=True):
        points[axis] = values
    points["intensity"] = [10, 20, 30]
    line = points.tobytes() + bytes(padding)
    fields = [
        {
            "name": name,
            "offset": point.fields[name][1],
            "datatype": CODES[point.fields[name][0].str[1:]],
            "count": 1,
        }
        for name in point.names
    ]
    return {
        "height": height,
        "width": len(XYZ),
        "fields": fields,
        "is_bigendian": order == ">",
        "point_step": 28,
        "row_step": len(line),
        "data": line * height,
        "is_dense": False,
    }


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("padding", "height"), [(0, 1), (5, 2)])
def test_row_points_packed_layout_returns_finite_points(order: str, padding: int, height: int) -> None:
    points = row_points(packed(order, padding=padding, height=height))
    assert points.xyz.tolist() == [[1, 2, 3], [4, -5, 6]] * height
    assert points.values is not None
    assert points.values.tolist() == [10, 30] * height


def test_row_points_lists_of_coordinates() -> None:
    columns = dict(zip("xyz", map(list, zip(*XYZ, strict=True)), strict=True))
    points = row_points({**columns, "intensity": None})
    assert points.xyz.tolist() == [[1, 2, 3], [4, -5, 6]]
    assert row_points({"points": [dict(zip("xyz", XYZ[0], strict=True))]}).xyz.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("ranges", [[1.0, 9.0, 2.0, math.nan], [[1.0, 5.0], [9.0], [2.0], []]])
def test_row_points_laser_scan_is_polar_and_within_its_limits(ranges: list[Any]) -> None:
    scan = {
        "angle_min": 0.0,
        "angle_increment": math.pi / 4,
        "range_min": 0.5,
        "range_max": 5.0,
        "ranges": ranges,
    }
    assert row_points(scan).xyz == pytest.approx(np.array([[1, 0, 0], [0, 2, 0]]), abs=1e-6)


@pytest.mark.parametrize(
    "columns",
    [
        {"fields": []},
        {"data": b"short"},
        {"point_step": 20},
        {"row_step": 10},
        {"point_step": 0},
    ],
)
def test_row_points_invalid_layout_raises_view_error(columns: dict[str, Any]) -> None:
    with pytest.raises(ViewError):
        row_points({**packed(), **columns})


def test_row_points_row_without_points_raises_view_error() -> None:
    with pytest.raises(ViewError):
        row_points({"value": 1})


def test_row_points_empty_cloud_has_no_points() -> None:
    assert not len(row_points({**packed(), "width": 0, "data": b"", "row_step": 0}).xyz)
    assert from_above(Points(np.empty((0, 3), np.float32)), size=20).shape == (20, 20, 3)


def test_from_above_has_x_to_the_right_and_y_up() -> None:
    corner = np.array([[0, 0, 0]] * 50 + [[10, 0, 0]] * 50 + [[0, 5, 9]] * 50, np.float32)
    pixels = from_above(Points(corner), size=300).astype(int)
    height, width, _ = pixels.shape
    assert width > height  # to scale
    colorful = np.argwhere(np.ptp(pixels, axis=2) > 40)
    top, bottom = colorful[:, 0].min(), colorful[:, 0].max()
    assert colorful[colorful[:, 0] == top][:, 1].max() < width / 4  # the point with y = 5 is at the top left
    assert colorful[:, 1].max() > width * 3 / 4
    assert bottom > height * 3 / 4
    high, low = pixels[top, colorful[0, 1]], pixels[bottom, colorful[:, 1].max()]
    assert high[0] > high[2]  # red
    assert low[2] > low[0]  # blue


def test_from_above_far_from_origin_shows_the_points_only() -> None:
    far = np.random.default_rng(1).uniform(0, 10, (500, 3)) + np.array([5000, 7000, 0])
    pixels = from_above(Points(far.astype(np.float32)), size=200).astype(int)
    assert (np.ptp(pixels, axis=2) > 40).mean() > 0.005
    assert min(pixels.shape[:2]) > 150


@pytest.mark.parametrize(("extent", "step"), [(10, 1), (11, 2), (45, 5), (99, 10), (0.9, 0.1)])
def test_grid_step_is_round(extent: float, step: float) -> None:
    assert grid_step(extent) == pytest.approx(step)


def test_grid_pixels_have_y_up_and_shades_of_occupancy() -> None:
    row = {"info": {"width": 3, "height": 2}, "data": [0, 100, -1, 50, 50, 50]}
    assert grid_pixels(row)[..., 0].tolist() == [[128, 128, 128], [255, 0, 128]]
    with pytest.raises(ViewError):
        grid_pixels({**row, "data": [0]})


@pytest.mark.parametrize(
    ("tag", "points", "grid"),
    [
        ("PointCloud2", True, False),
        ("Lidar", True, False),
        ("Radar", True, False),
        ("LaserScan", True, False),
        ("MultiEchoLaserScan", True, False),
        ("GridCells", True, False),
        ("OccupancyGrid", False, True),
        ("IMU", False, False),
        ("Point3d", False, False),
        ("Image", False, False),
    ],
)
def test_has_points_and_has_grid_by_ontology_type(tag: str, points: int, grid: int) -> None:
    schema = pa.schema(builtin_type(tag).struct)
    assert (has_points(schema), has_grid(schema)) == (points, grid)


def test_row_picture_shows_clouds_and_images_of_quickstart(quickstart: Store) -> None:
    topics = {topic.name: topic for topic in quickstart.sequence("quickstart_drive").topics}
    pictures = {name: topic for name, topic in topics.items() if has_pictures(topic)}
    assert set(pictures) == {"/camera/image_raw/compressed", "/lidar/points"}
    for topic in pictures.values():
        row = nearest_row(topic)
        assert row is not None
        assert np.ptp(row_picture(topic, row, size=300)) > 100
    with pytest.raises(ViewError):
        row_picture(topics["/imu"], {})
