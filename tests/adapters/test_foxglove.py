"""Foxglove's well-known schemas become the same rows in their ROS 2, protobuf and JSON forms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from foxglove_schemas import MESSAGES, json_definition, json_payload, protobuf_definition, protobuf_payload
from protobuf_schemas import definition_of, proto3_file

from mosaico_ingest.adapters.adapter import AdapterSpec, Envelope
from mosaico_ingest.adapters.builtin import BUILTIN, BY_TYPE
from mosaico_ingest.adapters.draft import draft
from mosaico_ingest.adapters.mapping.loader import load_adapter
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition
from mosaico_ingest.rosbag.encodings.json_messages import JsonCodec
from mosaico_ingest.rosbag.encodings.protobuf import ProtobufCodec


def adapter_of(name: str) -> AdapterSpec:
    return next(spec for spec in BUILTIN if f"foxglove.{name}" in spec.ros_types)


def row_of(name: str, definition: Definition, message: dict[str, Any]) -> dict[str, Any]:
    adapted = adapter_of(name).bind(definition, ros_shape(definition))
    rows: Any = pa.array([message], ros_shape(definition))
    result = adapted.adapt(rows, Envelope("/t", definition.root, np.zeros(1, np.int64)))
    assert not result.failures
    return result.rows[0].as_py()


@pytest.mark.parametrize("name", MESSAGES)
def test_foxglove_message_becomes_the_same_row_in_every_form(
    name: str, define: Callable[..., Definition]
) -> None:
    message = MESSAGES[name]
    ros = define(f"foxglove_msgs/msg/{name}")
    proto, text = protobuf_definition(name), json_definition(name)
    expected = row_of(name, ros, message)
    assert row_of(name, proto, ProtobufCodec(proto).to_dict(protobuf_payload(name, message))) == expected
    assert row_of(name, text, JsonCodec(text).to_dict(json_payload(message))) == expected


def test_foxglove_types_whose_fields_have_columns_have_a_default_adapter() -> None:
    without_default = {"JointStates", "Log"}
    names = MESSAGES.keys() - without_default
    assert all(f"foxglove.{name}" in BY_TYPE and f"foxglove_msgs/msg/{name}" in BY_TYPE for name in names)
    assert not [name for name in without_default if f"foxglove.{name}" in BY_TYPE]


def test_foxglove_values_that_are_absent_are_nan() -> None:
    message = {"joints": [{"name": "elbow", "position": 0.5}]}
    row = row_of("JointStates", protobuf_definition("JointStates"), message)
    assert row["positions"] == [0.5]
    assert np.isnan([*row["velocities"], *row["efforts"]]).all()
    message = {key: value for key, value in MESSAGES["Odometry"].items() if "velocity" not in key}
    definition = json_definition("Odometry")
    row = row_of("Odometry", definition, JsonCodec(definition).to_dict(json_payload(message)))
    assert np.isnan([row["velocity"]["linear"][axis] for axis in "xyz"]).all()


@pytest.mark.parametrize(
    ("seconds", "nanos", "rule"), [(2**31, 0, "out-of-range"), (0, 10**9, "nanosec"), (0, -1, "nanosec")]
)
def test_foxglove_time_that_does_not_fit_rejects_the_row(seconds: int, nanos: int, rule: str) -> None:
    definition = protobuf_definition("PoseInFrame")
    adapter = adapter_of("PoseInFrame").bind(definition, ros_shape(definition))
    stamps = [{"seconds": seconds, "nanos": nanos}, {"seconds": 1, "nanos": 2}]
    rows: Any = pa.array([{"timestamp": stamp, "frame_id": "a"} for stamp in stamps], ros_shape(definition))
    adapted = adapter.adapt(rows, Envelope("/t", definition.root, np.zeros(2, np.int64)))
    assert [(failure.row, failure.rule) for failure in adapted.failures] == [(0, rule)]
    assert adapted.rows[0].as_py()["header"]["timestamp"] == {"seconds": 1, "nanoseconds": 2}


def test_foxglove_absent_time_is_null_and_partial_time_is_rejected() -> None:
    definition = json_definition("PoseInFrame")
    adapter = adapter_of("PoseInFrame").bind(definition, ros_shape(definition))
    rows: Any = pa.array([{"frame_id": "a"}, {"timestamp": {"sec": 1}}], ros_shape(definition))
    adapted = adapter.adapt(rows, Envelope("/t", definition.root, np.zeros(2, np.int64)))
    assert [(failure.row, failure.rule) for failure in adapted.failures] == [(1, "null")]
    assert adapted.rows[0].as_py()["header"] == {"timestamp": None, "frame_id": "a", "sample_counter": None}


@pytest.mark.parametrize("definition", [protobuf_definition("PointCloud"), json_definition("PointCloud")])
def test_draft_of_protobuf_and_json_types_binds(definition: Definition) -> None:
    text = draft(definition)
    spec = load_adapter(text)
    assert spec.check(definition, ros_shape(definition)) == ()
    assert "ros_type: foxglove.PointCloud" in text
    assert "definition:" not in text


def test_draft_of_all_protobuf_features_binds() -> None:
    definition = definition_of(proto3_file(), "all.Message")
    assert load_adapter(draft(definition)).check(definition, ros_shape(definition)) == ()
