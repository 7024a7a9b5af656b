"""Round trips of random messages through every built-in adapter."""

from __future__ import annotations

import re
import struct
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from message_differences import differing
from random_messages import random_rows

from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.builtin import BUILTIN, Builtin
from mosaico_ingest.adapters.inverse import invert
from mosaico_ingest.adapters.standalone import DefinitionFinder
from mosaico_ingest.errors import BagError
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition

DOCS = Path(__file__).parents[2] / "docs" / "export.md"
MESSAGES = 60
SEEDS = 3
NOT_THE_SAME_AGAIN = {
    "FoxgloveLaserScanAdapter": {"angle_increment"},
    "GPSFixAdapter": {"velocity"},
    "Pose2DAdapter": {"orientation"},
}
"""Columns that differ after the round trip: `velocity` is not restored, the others are computed with rounding."""


@cache
def listed() -> tuple[tuple[str, str], ...]:
    """Return adapter and field of the losses in the documentation; `*` stands for every adapter."""
    table = DOCS.read_text().split("<!-- losses -->")[1].split("<!-- end of losses -->")[0]
    actual: list[tuple[str, str]] = []
    for line in table.strip().splitlines()[2:]:
        adapters, fields, _ = (cell.strip() for cell in line.strip("|").split("|"))
        names = re.findall(r"`(\w+)`", adapters) if "`" in adapters else ["*"]
        actual += [(name, field) for name in names for field in re.findall(r"`([^`]+)`", fields)]
    return tuple(actual)


def covers(name: str, known: str, adapter: str, field: str) -> bool:
    """Say whether a line of the documentation is about a field of an adapter."""
    if name == "*":
        return field.endswith(known)
    return name == adapter and (field == known or field.startswith((f"{known}.", f"{known}[]")))


def is_listed(adapter: str, field: str) -> bool:
    return any(covers(name, known, adapter, field) for name, known in listed())


def definition_of(spec: Builtin, msgtype: str, distro: Stores) -> Definition | None:
    try:
        return DefinitionFinder(distro).find(msgtype, spec)
    except BagError:
        return None


@cache
def definitions(spec: Builtin) -> list[Definition]:
    distros = (Stores.LATEST, Stores.ROS1_NOETIC)
    actual = (definition_of(spec, msgtype, distro) for distro in distros for msgtype in spec.ros_types)
    return [definition for definition in actual if definition is not None]


def there_and_back(spec: Builtin, definition: Definition, rows: pa.StructArray) -> tuple[set[str], set[str]]:
    """Return the fields that differ, and the columns that would."""
    shape = ros_shape(definition)
    adapter = spec.bind(definition, shape)
    times = np.arange(len(rows), dtype=np.int64)
    adapted = adapter.adapt(rows, Envelope("/t", definition.root, times))
    assert len(adapted.rows), adapted.failures[:1]
    envelope = Envelope("/t", definition.root, times[adapted.index])
    restored = invert(adapter, definition, adapter.topic_metadata(rows[0])).restore(adapted.rows, envelope)
    assert restored.rows.type == shape
    fields = set[str]()
    source = rows.take(pa.array(adapted.index))
    for before, after in zip(source.to_pylist(), restored.rows.to_pylist(), strict=True):
        fields |= set(differing(before, after))
    return fields, set(restored.changed or {})


@pytest.mark.parametrize("spec", BUILTIN, ids=lambda spec: spec.name)
def test_builtin_adapter_round_trip_differs_only_in_listed_fields(spec: Builtin) -> None:
    known = definitions(spec)
    assert known
    for definition in known:
        rows = random_rows(ros_shape(definition), MESSAGES, seed=len(definition.root))
        fields, changed = there_and_back(spec, definition, rows)
        assert {field for field in fields if not is_listed(spec.name, field)} == set()
        assert changed <= NOT_THE_SAME_AGAIN.get(spec.name, set())


@pytest.mark.slow
def test_every_listed_field_differs_for_some_message() -> None:
    seen: set[tuple[str, str]] = set()
    for spec in BUILTIN:
        for definition in definitions(spec):
            shape = ros_shape(definition)
            for seed in range(SEEDS):
                fields, _ = there_and_back(spec, definition, random_rows(shape, MESSAGES, seed=seed))
                seen |= {(spec.name, field) for field in fields}
    needless = [
        line for line in listed() if not any(covers(*line, adapter, field) for adapter, field in seen)
    ]
    assert needless == []


def test_every_listed_field_exists() -> None:
    by_name = {spec.name: spec for spec in BUILTIN}
    for adapter, field in listed():
        if adapter == "*":
            continue
        shapes = [ros_shape(definition) for definition in definitions(by_name[adapter])]
        assert any(has_field(shape, field) for shape in shapes), f"{adapter}: {field}"


def has_field(shape: pa.DataType, field: str) -> bool:
    for name in field.replace("[]", "").split("."):
        element = shape.value_type if pa.types.is_list(shape) else shape
        if element.get_field_index(name) < 0:
            return False
        shape = element.field(name).type
    return True


def test_round_trip_distinguishes_unmeasured_quantity_from_nan() -> None:
    spec = next(one for one in BUILTIN if one.name == "IMUAdapter")
    definition = DefinitionFinder().find("sensor_msgs/msg/Imu")
    nan, none = float("nan"), [-1.0] + [0.0] * 8
    message = random_rows(ros_shape(definition), 1)[0].as_py()
    vector = {"x": nan, "y": 1.0, "z": 2.0}
    messages = [
        message | {"linear_acceleration": vector},
        message | {"linear_acceleration_covariance": none, "orientation_covariance": none},
    ]
    rows = pa.array(messages, ros_shape(definition))
    fields, changed = there_and_back(spec, definition, rows)
    assert all(field.startswith("linear_acceleration.") for field in fields)
    assert not changed


def cloud(points: list[tuple[float, float, float, int]]) -> bytes:
    return b"".join(struct.pack("<fffH", *point) for point in points)


def test_round_trip_of_unpacked_point_cloud_has_the_same_points() -> None:
    spec = next(one for one in BUILTIN if one.name == "LidarAdapter")
    definition = DefinitionFinder().find("sensor_msgs/msg/PointCloud2")
    fields = [
        {"name": name, "offset": offset, "datatype": datatype, "count": 1}
        for name, offset, datatype in (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("ring", 12, 4))
    ]
    empty = random_rows(ros_shape(definition), 1)[0].as_py()
    messages = [
        empty
        | {
            "height": 1,
            "width": len(points),
            "fields": fields,
            "point_step": 14,
            "row_step": 14 * len(points),
        }
        | {"data": cloud(points)}
        for points in ([(1.0, 2.0, 3.0, 3), (4.0, float("nan"), 0.0, 6)], [])
    ]
    rows = pa.array(messages, ros_shape(definition))
    fields_that_differ, changed = there_and_back(spec, definition, rows)
    assert not changed
    assert "header" not in fields_that_differ
