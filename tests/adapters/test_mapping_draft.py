"""A first draft of an adapter is an adapter: it loads, binds, and passes its test, whatever the type."""

from __future__ import annotations

import pytest

from mosaico_ingest.adapters.mapping.draft import draft_adapter
from mosaico_ingest.adapters.mapping.load import load_adapter
from mosaico_ingest.adapters.mapping.trial import run_tests
from mosaico_ingest.bag.shape import ros_shape
from mosaico_ingest.bag.types import TypeResolver
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.ontology.registry import ontology_type
from mosaico_ingest.ontology.tags import MODULES

ODD = """\
uint64 timestamp_ns
int32 from
bool on
uint8[3] rgb
wstring wide
time_like[] empty_ones
builtin_interfaces/Time[2] twice
std_msgs/Header[] headers
geometry_msgs/PoseStamped[] poses
"""


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
def test_a_draft_is_an_adapter_that_passes_its_own_test(msgtype: str) -> None:
    resolver = TypeResolver("ros2_humble", types={"a/msg/Odd": ODD, "a/msg/time_like": "int32 NOTHING=1\n"})
    definition = resolver.resolve(msgtype, None, ros_version=2)
    shape = ros_shape(definition)
    text = draft_adapter(definition, shape)
    spec = load_adapter(text, file="draft.yaml", adapters=None)
    assert spec.check(definition, shape) == (), text
    assert [outcome.problems for outcome in run_tests(spec, resolver)] == [()], text


@pytest.mark.parametrize("tag", sorted(set(MODULES) - {"Unmodeled", "Floating16"}))
@pytest.mark.parametrize("msgtype", ["sensor_msgs/msg/Imu", "sensor_msgs/msg/Image", "nav_msgs/msg/Odometry"])
def test_a_draft_for_an_ontology_type_is_an_adapter(msgtype: str, tag: str) -> None:
    resolver = TypeResolver()
    definition = resolver.resolve(msgtype, None, ros_version=2)
    shape = ros_shape(definition)
    text = draft_adapter(definition, shape, name="DraftAdapter", ontology=ontology_type(tag))
    spec = load_adapter(text, file="draft.yaml")
    assert spec.check(definition, shape) == (), text
    assert [outcome.problems for outcome in run_tests(spec, resolver)] == [()], text


def test_a_draft_takes_the_fields_that_have_the_column_s_names() -> None:
    definition = TypeResolver().resolve("sensor_msgs/msg/BatteryState", None, ros_version=2)
    text = draft_adapter(definition, ros_shape(definition), ontology=ontology_type("BatteryState"))
    assert "  voltage: voltage\n" in text
    assert "  present: present\n" in text
    assert "# not used" not in text


def test_a_type_without_fields_cannot_be_drafted() -> None:
    definition = TypeResolver().resolve("std_msgs/msg/Empty", None, ros_version=2)
    with pytest.raises(AdapterError, match="has no fields"):
        draft_adapter(definition, ros_shape(definition))
