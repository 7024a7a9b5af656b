"""Foxglove's well-known schemas in their protobuf and JSON forms, and messages in all forms."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from typing import Any

from google.protobuf import descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet

from mosaico_ingest.rosbag.definitions.model import Definition, Embedded
from mosaico_ingest.rosbag.encodings import json_schema, protobuf

_POSE = {"position": {"x": 1.0, "y": 2.0, "z": 3.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
_HEAD = {"timestamp": {"sec": 1_700_000_000, "nanosec": 5}, "frame_id": "map"}
_TRANSFORM = {
    "timestamp": _HEAD["timestamp"],
    "parent_frame_id": "map",
    "child_frame_id": "odom",
    "translation": _POSE["position"],
    "rotation": _POSE["orientation"],
}
MESSAGES: dict[str, dict[str, Any]] = {
    "CompressedImage": {**_HEAD, "data": b"\xff\xd8", "format": "jpeg"},
    "CompressedVideo": {**_HEAD, "data": b"\x00\x01", "format": "h264"},
    "RawImage": {**_HEAD, "width": 1, "height": 1, "encoding": "rgb8", "step": 3, "data": b"\x01\x02\x03"},
    "PointCloud": {
        **_HEAD,
        "pose": _POSE,
        "point_stride": 4,
        "fields": [{"name": "x", "offset": 0, "type": 7}],
        "data": b"\x00\x00\x80\x3f",
    },
    "LaserScan": {
        **_HEAD,
        "pose": _POSE,
        "start_angle": -0.5,
        "end_angle": 0.5,
        "ranges": [1.0, 2.0, 2.5],
        "intensities": [7.0, 8.0, 9.0],
    },
    "LocationFix": {
        **_HEAD,
        "latitude": 45.5,
        "longitude": 9.25,
        "altitude": 100.0,
        "position_covariance": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 4.0],
        "position_covariance_type": 2,
        "heading": 0.25,
        "velocity": {"x": 1.0, "y": 2.0, "z": 3.0},
        "color": {"r": 0.0, "g": 0.5, "b": 1.0, "a": 1.0},
        "metadata": [{"key": "k", "value": "v"}],
    },
    "FrameTransform": _TRANSFORM,
    "FrameTransforms": {"transforms": [_TRANSFORM, {**_TRANSFORM, "child_frame_id": "base"}]},
    "PoseInFrame": {**_HEAD, "pose": _POSE},
    "PosesInFrame": {**_HEAD, "poses": [_POSE, _POSE]},
    "CameraCalibration": {
        **_HEAD,
        "width": 640,
        "height": 480,
        "distortion_model": "plumb_bob",
        "d": [0.5],
        "k": [float(number) for number in range(9)],
        "r": [float(number) for number in range(9)],
        "p": [float(number) for number in range(12)],
    },
    "JointStates": {
        "timestamp": _HEAD["timestamp"],
        "joints": [{"name": "elbow", "position": 0.5, "velocity": 1.5, "acceleration": 2.5, "effort": 3.5}],
    },
    "Odometry": {
        **_HEAD,
        "body_frame_id": "base",
        "pose": _POSE,
        "linear_velocity": _POSE["position"],
        "angular_velocity": _POSE["position"],
        "pose_covariance": [1.0] + 35 * [0.0],
        "velocity_covariance": [2.0] + 35 * [0.0],
        "metadata": [{"key": "k", "value": "v"}],
    },
    "Log": {
        "timestamp": _HEAD["timestamp"],
        "level": 2,
        "message": "ready",
        "name": "n",
        "file": "f",
        "line": 3,
    },
    "Point2": {"x": 1.0, "y": 2.0},
    "Vector2": {"x": 1.0, "y": 2.0},
    "Point3": _POSE["position"],
    "Point3InFrame": {**_HEAD, "point": _POSE["position"]},
    "Vector3": _POSE["position"],
    "Quaternion": _POSE["orientation"],
    "Pose": _POSE,
}
"""One message per schema, with the field names of ROS 2."""

_GEOMETRY = {
    "Point3": "Point",
    "Point3InFrame": "PointStamped",
    "Vector3": "Vector3",
    "Quaternion": "Quaternion",
    "Pose": "Pose",
}
"""Schemas whose ROS 2 form is a type of geometry_msgs."""

_NESTED = {
    "pose": "Pose",
    "poses": "Pose",
    "position": "Vector3",
    "translation": "Vector3",
    "orientation": "Quaternion",
    "rotation": "Quaternion",
    "transforms": "FrameTransform",
    "fields": "PackedElementField",
    "joints": "JointState",
    "point": "Point3",
    "velocity": "Vector3",
    "color": "Color",
    "linear_velocity": "Vector3",
    "angular_velocity": "Vector3",
    "metadata": "KeyValuePair",
}
_ENUMS = {"type": "NumericType", "level": "Level", "position_covariance_type": "PositionCovarianceType"}
_UPPER = {"d": "D", "k": "K", "r": "R", "p": "P"}
"""Names that are upper case in protobuf and JSON, where ROS 2 requires lower case."""


def ros_form(name: str) -> tuple[str, dict[str, Any]]:
    """Return the type and the message of a schema in ROS 2."""
    message = MESSAGES[name]
    if name == "Point3InFrame":
        message = {
            "header": {"stamp": message["timestamp"], "frame_id": message["frame_id"]},
            "point": message["point"],
        }
    geometry = _GEOMETRY.get(name)
    return f"geometry_msgs/msg/{geometry}" if geometry else f"foxglove_msgs/msg/{name}", message


def protobuf_definition(name: str) -> Definition:
    """Return the protobuf form of a schema."""
    return protobuf.read_schema(
        f"foxglove.{name}", Embedded.from_bytes("protobuf", _files().SerializeToString())
    )


def json_definition(name: str, example: Mapping[str, Any] | None = None) -> Definition:
    """Return the JSON form of a schema with the fields of an example, by default of the one in `MESSAGES`."""
    schema = json.dumps(_json_schema(f"foxglove.{name}", example or MESSAGES[name]))
    return json_schema.read_schema(f"foxglove.{name}", Embedded("jsonschema", schema))


def protobuf_payload(name: str, message: Mapping[str, Any]) -> bytes:
    """Return a message as protobuf."""
    pool = descriptor_pool.DescriptorPool()
    for file in _files().file:
        pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(f"foxglove.{name}"))
    return kind(**_with_times(message, "seconds", "nanos")).SerializeToString()


def json_payload(message: Mapping[str, Any]) -> bytes:
    """Return a message as JSON, with times as `{sec, nsec}` and bytes as base64."""
    return json.dumps(_with_base64(_with_times(message, "sec", "nsec"))).encode()


def _with_times(value: Any, seconds: str, nanoseconds: str) -> Any:
    if isinstance(value, list):
        return [_with_times(item, seconds, nanoseconds) for item in value]
    if not isinstance(value, Mapping):
        return value
    if "nanosec" in value:
        return {seconds: value["sec"], nanoseconds: value["nanosec"]}
    return {_UPPER.get(key, key): _with_times(one, seconds, nanoseconds) for key, one in value.items()}


def _with_base64(value: Any) -> Any:
    if isinstance(value, list):
        return [_with_base64(item) for item in value]
    if isinstance(value, Mapping):
        return {key: _with_base64(one) for key, one in value.items()}
    return base64.b64encode(value).decode() if isinstance(value, bytes) else value


def _files() -> FileDescriptorSet:
    files = FileDescriptorSet()
    timestamp_pb2.DESCRIPTOR.CopyToProto(files.file.add())
    file = files.file.add(name="foxglove.proto", package="foxglove", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    for enum in _ENUMS.values():
        values = file.enum_type.add(name=enum)
        for number in range(9):
            values.value.add(name=f"{enum}_{number}", number=number)
    for name, message in MESSAGES.items():
        _add_message(file, name, message)
    return files


def _add_message(file: FileDescriptorProto, name: str, example: Mapping[str, Any]) -> None:
    if any(message.name == name for message in file.message_type):
        return
    message = file.message_type.add(name=name)
    for number, (key, value) in enumerate(example.items(), 1):
        item = value[0] if isinstance(value, list) else value
        label = (
            FieldDescriptorProto.LABEL_REPEATED
            if isinstance(value, list)
            else FieldDescriptorProto.LABEL_OPTIONAL
        )
        field = message.field.add(name=_UPPER.get(key, key), number=number, label=label)
        if isinstance(item, Mapping):
            field.type = FieldDescriptorProto.TYPE_MESSAGE
            nested = _NESTED.get(key)
            field.type_name = ".google.protobuf.Timestamp" if nested is None else f".foxglove.{nested}"
        elif key in _ENUMS:
            field.type, field.type_name = FieldDescriptorProto.TYPE_ENUM, f".foxglove.{_ENUMS[key]}"
        else:
            kinds = {bytes: "BYTES", str: "STRING", float: "DOUBLE", int: "FIXED32"}
            field.type = getattr(FieldDescriptorProto, f"TYPE_{kinds[type(item)]}")
    for key, value in example.items():
        item = value[0] if isinstance(value, list) else value
        if isinstance(item, Mapping) and key in _NESTED:
            _add_message(file, _NESTED[key], item)


def _json_schema(title: str, example: Any) -> dict[str, Any]:
    if isinstance(example, Mapping) and "nanosec" in example:
        part = {"type": "integer", "minimum": 0}
        return {
            "type": "object",
            "title": "time",
            "properties": {"sec": part, "nsec": {**part, "maximum": 999_999_999}},
        }
    if isinstance(example, Mapping):
        properties = {
            _UPPER.get(key, key): _json_schema(f"foxglove.{_NESTED.get(key, key)}", one)
            for key, one in example.items()
        }
        return {"title": title, "type": "object", "properties": properties}
    if isinstance(example, list):
        return {"type": "array", "items": _json_schema(title, example[0])}
    if isinstance(example, bytes):
        return {"type": "string", "contentEncoding": "base64"}
    return {"type": {str: "string", float: "number", int: "integer"}[type(example)]}
