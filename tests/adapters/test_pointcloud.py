"""Unpacking of point clouds in batches, compared with single values read by `struct`."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosaico_ingest.adapters.adapter import Adapted
from mosaico_ingest.adapters.builtin import BY_NAME
from mosaico_ingest.rosbag.definitions.model import Definition

FORMATS = {1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "f", 8: "d"}
Unpack = Callable[..., Adapted]


@pytest.fixture(scope="session")
def unpack(define: Callable[..., Definition], adapt: Callable[..., Adapted]) -> Unpack:
    definition = define("sensor_msgs/msg/PointCloud2")

    def run(name: str, clouds: list[dict[str, Any]]) -> Adapted:
        return adapt(BY_NAME[name], definition, clouds)

    return run


@st.composite
def clouds(draw: st.DrawFn, *, fields: list[dict[str, Any]] | None = None, step: int = 0) -> dict[str, Any]:
    """Return a cloud of random bytes with x, y, z and other fields at any offsets, with or without row padding."""
    if fields is None:
        fields, step = draw(layouts())
    height, width, padding = (
        draw(st.integers(0, 3)),
        draw(st.integers(0, 4)),
        draw(st.sampled_from((0, 0, 3))),
    )
    row_step = width * step + padding
    data = draw(st.binary(min_size=height * row_step, max_size=height * row_step))
    return {
        "height": height, "width": width, "fields": fields, "point_step": step, "row_step": row_step,
        "is_bigendian": draw(st.booleans()), "data": data, "is_dense": True,
    }  # fmt: skip


@st.composite
def layouts(draw: st.DrawFn) -> tuple[list[dict[str, Any]], int]:
    names = ["x", "y", "z", *draw(st.lists(st.sampled_from(["intensity", "range", "label"]), unique=True))]
    offset, fields = draw(st.integers(0, 3)), list[dict[str, Any]]()
    for name in draw(st.permutations(names)):
        kind = draw(st.sampled_from(sorted(FORMATS)))
        fields.append({"name": name, "offset": offset, "datatype": kind, "count": 1})
        offset += struct.calcsize(FORMATS[kind]) + draw(st.integers(0, 2))
    return fields, offset + draw(st.integers(0, 3))


def _one_by_one(cloud: dict[str, Any], name: str) -> list[float] | None:
    """Return a field as float32, read point by point."""
    entry = next((field for field in cloud["fields"] if field["name"] == name), None)
    if entry is None:
        return None
    code = (">" if cloud["is_bigendian"] else "<") + FORMATS[entry["datatype"]]
    starts = [
        line * cloud["row_step"] + column * cloud["point_step"] + entry["offset"]
        for line in range(cloud["height"])
        for column in range(cloud["width"])
    ]
    with np.errstate(over="ignore"):
        values = [np.float32(struct.unpack_from(code, cloud["data"], start)[0]) for start in starts]
    return [float(value) for value in values]


def _assert_same(adapted: Adapted, given: list[dict[str, Any]]) -> None:
    assert adapted.failures == ()
    for row, cloud in zip(adapted.rows.to_pylist(), given, strict=True):
        for name in ("x", "y", "z", "intensity", "range"):
            assert str(row[name]) == str(_one_by_one(cloud, name)), name


@settings(max_examples=60, deadline=None)
@given(given_clouds=st.lists(clouds(), min_size=1, max_size=4))
def test_points_of_different_layouts_equal_reference(
    unpack: Unpack, given_clouds: list[dict[str, Any]]
) -> None:
    _assert_same(unpack("LidarAdapter", given_clouds), given_clouds)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_points_of_one_layout_share_one_block(unpack: Unpack, data: st.DataObject) -> None:
    fields, step = data.draw(layouts())
    given_clouds = data.draw(st.lists(clouds(fields=fields, step=step), min_size=1, max_size=5))
    for cloud in given_clouds:
        cloud["is_bigendian"] = given_clouds[0]["is_bigendian"]
    _assert_same(unpack("LidarAdapter", given_clouds), given_clouds)


def _cloud(**changes: Any) -> dict[str, Any]:
    fields = [{"name": n, "offset": 4 * i, "datatype": 7, "count": 1} for i, n in enumerate("xyz")]
    cloud: dict[str, Any] = {
        "height": 1, "width": 1, "fields": fields, "point_step": 12, "row_step": 12,
        "is_bigendian": False, "data": struct.pack("<fff", 1, 2, 3), "is_dense": True,
    }  # fmt: skip
    return {**cloud, **changes}


def _field(name: str, datatype: int, offset: int = 0, count: int = 1) -> dict[str, Any]:
    return {"name": name, "offset": offset, "datatype": datatype, "count": count}


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"width": 2}, "1 x 2 points of 12 bytes, row_step 24, do not fit 12 bytes of data"),
        ({"height": 2, "row_step": 6}, "2 x 1 points of 12 bytes, row_step 6, do not fit 12 bytes of data"),
        ({"height": 2**32 - 1, "width": 2**32 - 1}, "do not fit 12 bytes of data"),
        ({"point_step": 0, "row_step": 0}, "field x ends at byte 4 of 0"),
        ({"fields": [_field("x", 9)]}, "field x has the unknown datatype 9"),
        ({"fields": [_field("x", 7, count=3)]}, "field x has 3 values"),
        ({"fields": [_field("x", 8, offset=8)]}, "field x ends at byte 16 of 12"),
        ({"fields": [_field("x", 7)]}, "y"),
    ],
)
def test_points_inconsistent_cloud_rejects_only_its_row(
    unpack: Unpack, changes: dict[str, Any], reason: str
) -> None:
    adapted = unpack("LidarAdapter", [_cloud(), _cloud(**changes), _cloud()])
    assert adapted.index.tolist() == [0, 2]
    (failure,) = adapted.failures
    assert failure.row == 1
    assert reason in failure.reason
    assert adapted.rows.field("x").to_pylist() == [[1.0], [1.0]]


def test_points_integer_out_of_range_rejects_row(unpack: Unpack) -> None:
    def with_ring(value: float) -> dict[str, Any]:
        fields = [*_cloud()["fields"], _field("ring", 7, 12)]
        data = struct.pack("<ffff", 1, 2, 3, value)
        return _cloud(fields=fields, point_step=16, row_step=16, data=data)

    adapted = unpack("LidarAdapter", [with_ring(5), with_ring(0.5), with_ring(-1), with_ring(65535)])
    assert adapted.rows.field("beam_id").to_pylist() == [[5], [65535]]
    assert [failure.row for failure in adapted.failures] == [1, 2]
    assert "0.5 is not a uint16" in adapted.failures[0].reason


@pytest.mark.parametrize("datatype", [6, 7])
@pytest.mark.parametrize("name", ["rgb", "rgba"])
@pytest.mark.parametrize("big", [False, True])
def test_points_packed_keeps_bytes(unpack: Unpack, datatype: int, name: str, *, big: bool) -> None:
    order = ">" if big else "<"
    data = struct.pack(f"{order}fffI", 1, 2, 3, 0x00AABBCC)
    fields = [*_cloud()["fields"], _field(name, datatype, 12)]
    cloud = _cloud(fields=fields, point_step=16, row_step=16, data=data, is_bigendian=big)
    rows = unpack("RGBDCameraAdapter", [cloud]).rows
    (color,) = rows.field("rgb").to_pylist()[0]
    assert struct.pack("<f", color) == struct.pack("<I", 0x00AABBCC)


def test_points_empty_cloud_is_empty_list(unpack: Unpack) -> None:
    nothing = _cloud(width=0, row_step=0, data=b"", fields=[], point_step=0)
    nan = _cloud(data=struct.pack("<fff", float("nan"), 2, 3))
    rows = unpack("LidarAdapter", [nothing, nan]).rows.to_pylist()
    assert (rows[0]["x"], rows[0]["intensity"]) == ([], [])
    assert str(rows[1]["x"]) == "[nan]"
    assert rows[1]["intensity"] is None
