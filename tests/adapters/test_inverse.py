"""Inversion of mapping expressions, for each kind of expression."""

from __future__ import annotations

import json
from typing import Any

import foxglove_schemas
import numpy as np
import pyarrow as pa
import pytest
from foxglove_schemas import protobuf_definition
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import define

from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.builtin import BY_TYPE
from mosaico_ingest.adapters.inverse import Restored, differences, invert
from mosaico_ingest.adapters.mapping.loader import load_adapter
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Embedded
from mosaico_ingest.rosbag.encodings import json_schema
from mosaico_ingest.rosbag.encodings.json_messages import JsonCodec
from mosaico_ingest.rosbag.encodings.protobuf import ProtobufCodec

DEFINITION = define(
    "acme_msgs/msg/T",
    """
uint8 IDLE=4
int32 i
uint16 u
float32 f
float64 d
bool flag
string text
float64[3] three
float64[] many
acme_msgs/Cell[] cells
acme_msgs/Cell cell
builtin_interfaces/Time when
================================================================================
MSG: acme_msgs/Cell
uint16 mv
float32 t
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
""",
)
CELLS = [{"mv": 4001, "t": 20.5}, {"mv": 3999, "t": -1.25}]
MESSAGE: dict[str, Any] = {
    "i": -7,
    "u": 4,
    "f": 0.1,
    "d": 1.5,
    "flag": True,
    "text": "a b",
    "three": [1.0, 2.0, 3.0],
    "many": [0.5],
    "cells": CELLS,
    "cell": CELLS[0],
    "when": {"sec": 3, "nanosec": 4},
}


def restore(type_: str, value: str, message: dict[str, Any]) -> Restored:
    """Convert one message with a mapping of one column, and invert the result."""
    text = (
        f"version: 1\nadapter: TAdapter\nros_type: acme_msgs/msg/T\n"
        f"ontology: {{tag: T, fields: {{x: {type_}}}}}\nfields:\n  x: {value}\n"
    )
    shape = ros_shape(DEFINITION)
    adapter = load_adapter(text).bind(DEFINITION, shape)
    envelope = Envelope("/t", DEFINITION.root, np.zeros(1, np.int64))
    adapted = adapter.adapt(pa.array([message], shape), envelope)
    assert not adapted.failures
    return invert(adapter, DEFINITION, {}).restore(adapted.rows, envelope)


@pytest.mark.parametrize(
    ("type_", "value", "field"),
    [
        ("int32", "i", "i"),
        ("float64", "f", "f"),
        ("float64", "i * 0.001", "i"),
        ("float64", "0.001 * i", "i"),
        ("float64", "-i / 1000 + 5", "i"),
        ("int64", "1000 - i", "i"),
        ("float64", "u / 100", "u"),
        ("uint8", "cast(u)", "u"),
        ("bool", "not flag", "flag"),
        ("uint8", "{value: u, map: {IDLE: 9, 1: 2}, else: error}", "u"),
        ("uint16", "{value: u, map: {1: 2}, else: keep}", "u"),
        ("float64", "nan_to_null(d)", "d"),
        ("float64", "nan if d == -1 else d", "d"),
        ("float64", "d if d > 0 else null", "d"),
        ("float64", "coalesce(d, 0.0)", "d"),
        ("float64", "null_if(d, 9.0)", "d"),
        ("float64", "degrees(radians(f))", "f"),
        ("'list[float64]'", "covariance(three)", "three"),
        ("'list[float64]'", "'[three[0], three[1], three[2]]'", "three"),
        ("{fields: {a: float64, b: float64, c: float64}}", "{fields: {a: 'three[0]', b: 'three[1]', c: 'three[2]'}}", "three"),
        ("'list[float64]'", "empty_to_null(many)", "many"),
        ("'list[float64, 3]'", "three", "three"),
        ("'list[float64]'", "'many[] * 2'", "many"),
        ("{fields: {seconds: int32, nanoseconds: uint32}}", "{fields: {seconds: when.sec, nanoseconds: when.nanosec}}", "when"),
        ("float64", "seconds(when)", "when"),
        ("int64", "nanoseconds(when)", "when"),
        ("{fields: {v: uint16, t: float32}}", "{of: cell, fields: {v: mv, t: t}}", "cell"),
        ("{type: list, fields: {v: float64, t: float32}}", "{of: 'cells[]', fields: {v: mv * 0.001, t: t}}", "cells"),
    ],
)  # fmt: skip
def test_invert_expression_restores_field(type_: str, value: str, field: str) -> None:
    restored = restore(type_, value, MESSAGE)
    assert not restored.not_invertible
    got = pa.array([MESSAGE], ros_shape(DEFINITION))
    assert restored.rows.field(field).to_pylist() == got.field(field).to_pylist()
    assert not restored.changed


@pytest.mark.parametrize("value", ["i + u", "len(many)", "sum(many)", "i % 3", "i if flag else u", "d ** 2"])
def test_invert_ambiguous_expression_reports_column(value: str) -> None:
    restored = restore("float64", value, MESSAGE)
    assert restored.not_invertible == {"x": value} or restored.changed
    assert {"text", "many", "cells"} <= set(restored.defaulted)
    assert restored.rows.field("cells").to_pylist() == [[]]


def test_invert_element_columns_rebuild_list() -> None:
    text = (
        "version: 1\nadapter: TAdapter\nros_type: acme_msgs/msg/T\n"
        "ontology: {tag: T, fields: {v: 'list[uint16]', t: 'list[float32]'}}\n"
        "fields: {v: 'cells[].mv', t: 'cells[].t'}\n"
    )
    shape = ros_shape(DEFINITION)
    adapter = load_adapter(text).bind(DEFINITION, shape)
    messages = [MESSAGE, MESSAGE | {"cells": []}, MESSAGE]
    envelope = Envelope("/t", DEFINITION.root, np.zeros(3, np.int64))
    adapted = adapter.adapt(pa.array(messages, shape), envelope)
    restored = invert(adapter, DEFINITION, {}).restore(adapted.rows, envelope)
    assert restored.rows.field("cells").to_pylist() == [CELLS, [], CELLS]


def test_invert_field_of_two_columns_uses_non_null_one() -> None:
    text = (
        "version: 1\nadapter: TAdapter\nros_type: acme_msgs/msg/T\n"
        "ontology: {tag: T, fields: {large: float64, all: float64}}\n"
        "fields: {large: d if d > 2 else null, all: d}\n"
    )
    shape = ros_shape(DEFINITION)
    adapter = load_adapter(text).bind(DEFINITION, shape)
    envelope = Envelope("/t", DEFINITION.root, np.zeros(2, np.int64))
    adapted = adapter.adapt(pa.array([MESSAGE, MESSAGE | {"d": 3.5}], shape), envelope)
    restored = invert(adapter, DEFINITION, {}).restore(adapted.rows, envelope)
    assert restored.rows.field("d").to_pylist() == [1.5, 3.5]
    assert not restored.changed


NUMBER = st.none() | st.floats(width=32)
VALUES = st.lists(
    st.fixed_dictionaries({"a": NUMBER, "b": st.none() | st.lists(NUMBER, max_size=2)}),
    min_size=1,
    max_size=4,
)
TYPE = pa.struct([("a", pa.float32()), ("b", pa.list_(pa.float32()))])


@given(VALUES, VALUES)
def test_differences_returns_rows_with_different_text(left: list[Any], right: list[Any]) -> None:
    size = min(len(left), len(right))
    left, right = left[:size], right[:size]
    actual = differences(pa.array(left, TYPE), pa.array(right, TYPE))
    for name in ("a", "b"):
        wrong = [spell(one[name]) != spell(other[name]) for one, other in zip(left, right, strict=True)]
        assert actual.get(name, np.zeros(size, bool)).tolist() == wrong


def spell(value: Any) -> str:
    return str(value).replace("-0.0", "0.0") if isinstance(value, (float, list)) else str(value)


JSON_SCHEMA = {
    "type": "object",
    "required": ["header", "speed"],
    "properties": {
        "header": {
            "type": "object",
            "properties": {
                "stamp": {
                    "type": "object",
                    "properties": {"sec": {"type": "integer"}, "nanosec": {"type": "integer"}},
                },
                "frame_id": {"type": "string"},
            },
        },
        "when": {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}},
        "speed": {"type": "number"},
        "limit": {"type": "number"},
        "names": {"type": "array", "items": {"type": "string"}},
        "axis": {"type": "object", "properties": {"x": {"type": "number"}, "y": {"type": "number"}}},
        "unused": {"type": "object", "properties": {"x": {"type": "number"}}},
    },
}
JSON_MAPPING = """
version: 1
adapter: TAdapter
ros_type: acme.T
ontology:
  tag: T
  fields:
    header: Header
    when: Time
    speed: float64
    limit: float64
    fast: float64
    names: list[string]
    axis: {fields: {x: float64, y: float64}}
fields:
  header: header
  when: ros_time(when)
  speed: speed
  limit: limit
  fast: {value: speed, when: speed > 5}
  names: names
  axis: {fields: {x: axis.x, y: axis.y}}
"""
EMPTY = {"header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}, "speed": 1.5}


def test_invert_absent_fields_of_json_messages_stay_absent() -> None:
    definition = json_schema.read_schema("acme.T", Embedded("jsonschema", json.dumps(JSON_SCHEMA)))
    codec, shape = JsonCodec(definition), ros_shape(definition)
    full = {"when": {"sec": 1, "nsec": 2}, "limit": 0.0, "names": ["a"], "axis": {"x": 1.0, "y": 2.0}}
    messages = [EMPTY, {**EMPTY, **full}, {**EMPTY, "names": [], "axis": {"y": 0.0}}]
    rows = pa.array([codec.to_dict(json.dumps(message).encode()) for message in messages], shape)
    adapter = load_adapter(JSON_MAPPING).bind(definition, shape)
    envelope = Envelope("/t", definition.root, np.zeros(3, np.int64))
    adapted = adapter.adapt(rows, envelope)
    assert not adapted.failures
    restored = invert(adapter, definition, {}).restore(adapted.rows, envelope)
    assert [json.loads(codec.from_dict(row)) for row in restored.rows.to_pylist()] == messages
    assert restored.changed == {}


REQUIRED_SCHEMA = {
    "type": "object",
    "properties": {
        "id": {"type": "integer"},
        "note": {"type": "string"},
        "origin": {
            "type": "object",
            "properties": {"x": {"type": "number"}, "y": {"type": "number"}},
            "required": ["x"],
        },
        "volts": {"type": "number"},
        "limit": {"type": "number"},
        "covariance": {"type": "array", "items": {"type": "number"}},
        "joints": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {
                    "name": {"type": "string"},
                    "load": {"type": "number"},
                    "rest": {"type": "number"},
                },
                "required": ["name"],
            },
        },
    },
    "required": ["id", "joints"],
}
REQUIRED_MAPPING = """
version: 1
adapter: RAdapter
ros_type: acme.R
ontology:
  tag: R
  fields:
    y: float64
    millivolts: float64
    limit: float64
    covariance: list[float64]
    joints: list[string]
    loads: list[float64]
fields:
  y: origin.y
  millivolts: volts * 1000
  limit: coalesce(limit, nan)
  covariance: covariance(covariance)
  joints: joints[].name
  loads: coalesce(joints[].load, -1.0)
"""


def test_invert_fields_that_are_not_stored_are_absent_unless_they_are_required() -> None:
    definition = json_schema.read_schema("acme.R", Embedded("jsonschema", json.dumps(REQUIRED_SCHEMA)))
    codec, shape = JsonCodec(definition), ros_shape(definition)
    joints: list[dict[str, Any]] = [{"name": "elbow", "load": 0.5}, {"name": "wrist"}]
    full = {"volts": 1.5, "limit": 2.0, "covariance": [1.0, 0.0]}
    messages: list[dict[str, Any]] = [
        {"id": 0, "joints": []},
        {"id": 0, "joints": joints, "origin": {"x": 0.0, "y": 1.0}, **full},
    ]
    lost = {"id": 7, "note": "n", "joints": [{"name": "elbow", "rest": 1.0}], "origin": {"x": 3.0, "y": 1.0}}
    kept = {"id": 0, "joints": [{"name": "elbow"}], "origin": {"x": 0.0, "y": 1.0}}
    payloads = [json.dumps(message).encode() for message in (*messages, lost)]
    rows = pa.array([codec.to_dict(payload) for payload in payloads], shape)
    adapter = load_adapter(REQUIRED_MAPPING).bind(definition, shape)
    envelope = Envelope("/t", definition.root, np.zeros(3, np.int64))
    adapted = adapter.adapt(rows, envelope)
    assert not adapted.failures
    restored = invert(adapter, definition, {}).restore(adapted.rows, envelope)
    again = [codec.from_dict(row) for row in restored.rows.to_pylist()]
    assert [json.loads(payload) for payload in again] == [*messages, kept]
    assert [codec.to_dict(payload)["id"] for payload in again] == [0, 0, 0]
    assert restored.changed == {}
    assert set(restored.defaulted) == {"id", "note", "origin.x", "joints[].rest"}


@pytest.mark.parametrize("name", ["LocationFix", "JointStates", "Odometry", "PoseInFrame"])
def test_invert_fields_that_foxglove_messages_lack_stay_absent(name: str) -> None:
    definition = protobuf_definition(name)
    codec, shape = ProtobufCodec(definition), ros_shape(definition)
    message = foxglove_schemas.MESSAGES[name]
    stored = {key: value for key, value in message.items() if key not in {"heading", "color", "metadata"}}
    if name == "JointStates":
        stored["joints"] = [{"name": "elbow", "position": 0.5}, {"name": "wrist", "effort": 0.0}]
    optional = {"velocity", "linear_velocity", "angular_velocity", "timestamp"} & stored.keys()
    messages = [stored, *({key: stored[key] for key in stored.keys() - {one}} for one in optional)]
    payloads = [foxglove_schemas.protobuf_payload(name, each) for each in messages]
    rows: Any = pa.array([codec.to_dict(payload) for payload in payloads], shape)
    adapter = BY_TYPE[f"foxglove.{name}"].bind(definition, shape)
    envelope = Envelope("/t", definition.root, np.zeros(len(rows), np.int64))
    adapted = adapter.adapt(rows, envelope)
    assert not adapted.failures
    restored = invert(adapter, definition, {}).restore(adapted.rows, envelope)
    again = [codec.from_dict(row) for row in restored.rows.to_pylist()]
    assert [codec.to_dict(payload) for payload in again] == rows.to_pylist()
    assert restored.changed == {}


def test_invert_absent_messages_of_protobuf_stay_absent() -> None:
    definition = protobuf_definition("PoseInFrame")
    shape = ros_shape(definition)
    adapter = BY_TYPE["foxglove.PoseInFrame"].bind(definition, shape)
    pose = {
        "position": {"x": 0.0, "y": 0.0, "z": 1.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
    }
    messages = [
        {"timestamp": None, "frame_id": "map", "pose": pose},
        {"timestamp": {"seconds": 0, "nanos": 0}, "frame_id": "", "pose": pose},
    ]
    envelope = Envelope("/t", definition.root, np.zeros(2, np.int64))
    adapted = adapter.adapt(pa.array(messages, shape), envelope)
    restored = invert(adapter, definition, {}).restore(adapted.rows, envelope)
    assert (restored.rows.to_pylist(), restored.changed) == (messages, {})
    payloads = [ProtobufCodec(definition).from_dict(message) for message in messages]
    assert [ProtobufCodec(definition).to_dict(payload) for payload in payloads] == messages
