"""Drafted adapters load, bind and pass their tests for any type."""

from __future__ import annotations

import pytest

from mosaico_ingest.adapters.builtin import BUILTIN, find_builtin
from mosaico_ingest.adapters.draft import draft
from mosaico_ingest.adapters.mapping.loader import load_adapter
from mosaico_ingest.adapters.standalone import DefinitionFinder, run_tests
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.ontology.registry import MODULES
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded
from mosaico_ingest.rosbag.definitions.registry import TypeResolver

ODD = """\
uint64 timestamp_ns
int32 from
bool on
float64 pi
uint8[3] rgb
wstring wide
time_like[] empty_ones
time_like empty_one
deep nested
deep[] nests
builtin_interfaces/Time[2] twice
std_msgs/Header[] headers
geometry_msgs/PoseStamped[] poses
"""
TYPES = {
    "a/msg/Odd": ODD,
    "a/msg/time_like": "int32 NOTHING=1\n",
    "a/msg/deep": "time_like nothing\nfloat32 class\nfloat64[9] matrix\nuint8[] data\n",
}


def fits(text: str, definition: Definition) -> None:
    spec = load_adapter(text, file="draft.yaml", adapters=find_builtin)
    assert spec.check(definition, ros_shape(definition)) == (), text
    resolver = TypeResolver("ros2_jazzy", types=TYPES)
    assert [outcome.problems for outcome in run_tests(spec, resolver)] == [()], text


@pytest.mark.parametrize(
    "msgtype",
    [
        "a/msg/Odd",
        "sensor_msgs/msg/Imu",
        "sensor_msgs/msg/PointCloud2",
        "sensor_msgs/msg/MultiEchoLaserScan",
        "sensor_msgs/msg/Range",
        "diagnostic_msgs/msg/DiagnosticArray",
        "visualization_msgs/msg/MarkerArray",
        "nav_msgs/msg/OccupancyGrid",
        "trajectory_msgs/msg/JointTrajectory",
        "std_msgs/msg/Float64MultiArray",
    ],
)
def test_draft_with_own_ontology_passes_its_test(msgtype: str) -> None:
    definition = TypeResolver("ros2_jazzy", types=TYPES).resolve(msgtype, None, ros_version=2)
    fits(draft(definition), definition)


@pytest.mark.parametrize("tag", sorted(set(MODULES) - {"Unmodeled", "Floating16"}))
@pytest.mark.parametrize("msgtype", ["sensor_msgs/msg/Imu", "sensor_msgs/msg/Image", "nav_msgs/msg/Odometry"])
def test_draft_for_ontology_type_passes_its_test(msgtype: str, tag: str) -> None:
    definition = DefinitionFinder().find(msgtype)
    fits(draft(definition, ontology=tag), definition)


def test_draft_maps_fields_by_column_name() -> None:
    text = draft(DefinitionFinder().find("sensor_msgs/msg/BatteryState"), ontology="BatteryState")
    assert "  voltage: voltage  # float32, required\n" in text
    assert "  present: present" in text
    assert "Not used" not in text


def test_draft_lists_unused_fields_and_matches_similar_names() -> None:
    text = draft(DefinitionFinder().find("sensor_msgs/msg/Imu"), ontology="IMU")
    assert "  acceleration: linear_acceleration" in text
    assert "Not used yet, of sensor_msgs/msg/Imu: orientation_covariance, angular_velocity_covariance" in text


def test_draft_with_embedded_definition_needs_no_distro() -> None:
    embedded = Embedded(
        "ros2msg",
        "geometry_msgs/Point where\nint32 COUNT=3\n"
        + "=" * 80
        + "\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n",
    )
    definition = TypeResolver().resolve("acme/msg/Mark", embedded, ros_version=2)
    text = draft(definition, embed=True)
    spec = load_adapter(text, file="draft.yaml", adapters=find_builtin)
    assert all(outcome.passed for outcome in run_tests(spec, TypeResolver()))
    assert "COUNT = 3" in text


def test_draft_of_type_without_fields_raises() -> None:
    with pytest.raises(AdapterError, match="has no fields"):
        draft(DefinitionFinder().find("std_msgs/msg/Empty"))


def test_draft_of_every_catalog_type_binds() -> None:
    for builtin in BUILTIN:
        definition = (
            DefinitionFinder().find(builtin.ros_types[0], builtin)
            if builtin.mapping.model.definition
            else None
        )
        if definition is not None:
            draft(definition, ontology=builtin.tag, embed=True)
