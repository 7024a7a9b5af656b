"""Foxglove's well-known schemas become the same rows in their ROS 2, protobuf and JSON forms."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from foxglove_schemas import (
    MESSAGES,
    json_definition,
    json_payload,
    protobuf_definition,
    protobuf_payload,
    ros_form,
)
from protobuf_schemas import definition_of, proto3_file

from mosaico_ingest.adapters.adapter import AdapterSpec, Envelope
from mosaico_ingest.adapters.builtin import BUILTIN, BY_TYPE, find_builtin
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
    msgtype, ros_message = ros_form(name)
    proto, text, message = protobuf_definition(name), json_definition(name), MESSAGES[name]
    expected = row_of(name, define(msgtype), ros_message)
    assert row_of(name, proto, ProtobufCodec(proto).to_dict(protobuf_payload(name, message))) == expected
    assert row_of(name, text, JsonCodec(text).to_dict(json_payload(message))) == expected


def test_foxglove_types_have_a_default_adapter_except_log() -> None:
    names = MESSAGES.keys() - {"Log"}
    assert all(f"foxglove.{name}" in BY_TYPE and ros_form(name)[0] in BY_TYPE for name in names)
    assert "foxglove.Log" not in BY_TYPE
    assert "foxglove_msgs/msg/Log" not in BY_TYPE


@pytest.mark.parametrize("form", ["protobuf", "json"])
def test_foxglove_location_fix_of_an_older_version_has_no_velocity(form: str) -> None:
    fields = ("timestamp", "frame_id", "latitude", "longitude", "altitude")
    fields += ("position_covariance", "position_covariance_type")
    message = {name: MESSAGES["LocationFix"][name] for name in fields}
    if form == "json":
        definition = json_definition("LocationFix", message)
        values = JsonCodec(definition).to_dict(json_payload(message))
    else:
        definition = protobuf_definition("LocationFix")
        values = ProtobufCodec(definition).to_dict(protobuf_payload("LocationFix", message))
    row = row_of("LocationFix", definition, values)
    assert (row["position"]["x"], row["velocity"]) == (45.5, None)


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
    spec = load_adapter(text, adapters=find_builtin)
    assert spec.check(definition, ros_shape(definition)) == ()
    assert "ros_type: foxglove.PointCloud" in text
    assert "definition:" not in text


def test_draft_of_all_protobuf_features_binds() -> None:
    definition = definition_of(proto3_file(), "all.Message")
    assert load_adapter(draft(definition)).check(definition, ros_shape(definition)) == ()


def test_page_lists_the_ontology_type_of_every_foxglove_schema() -> None:
    page = (Path(__file__).parents[2] / "docs" / "encodings.md").read_text()
    mapped, unmodeled = (
        page.split("## Foxglove schemas")[1].split("## Protobuf")[0].split("Without an adapter")
    )
    for row in re.findall(r"^\| (`.*) \| `(\w+)` \|", mapped, re.MULTILINE):
        for name in re.findall(r"`(\w+)`", row[0]):
            assert BY_TYPE[f"foxglove.{name}"].tag == row[1]
            assert name in MESSAGES
    names = set(re.findall(r"`(\w+)`", mapped)) | set(re.findall(r"`(\w+)`", unmodeled))
    assert names >= MESSAGES.keys()
    rows = re.findall(r"^\| (`.*?) \|", unmodeled, re.MULTILINE)
    unadapted = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert len(unadapted) > 20
    assert not [name for name in unadapted if f"foxglove.{name}" in BY_TYPE]
