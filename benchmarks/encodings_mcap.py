"""Recordings of protobuf and JSON messages: poses, joint states and events in equal parts."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf import descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet

from mosaico_ingest.rosbag.definitions.model import Embedded
from mosaico_ingest.rosbag.encodings import json_schema, protobuf
from mosaico_ingest.rosbag.mcap.writer import McapWriter

MESSAGES = 100_000
START_NS = 1_700_000_000_000_000_000
STEP_NS = 1_000_000

F = FieldDescriptorProto
TYPES: dict[str, dict[str, Any]] = {
    "Vector": {"x": 0.0, "y": 0.0, "z": 0.0},
    "Quaternion": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 0.0},
    "Pose": {"stamp": "Time", "frame_id": "", "position": "Vector", "orientation": "Quaternion"},
    "Joints": {"stamp": "Time", "names": [""], "positions": [0.0], "velocities": [0.0]},
    "Event": {"stamp": "Time", "level": 0, "source": "", "text": "", "is_active": False},
}
"""The fields of each type, with an example of the value or the name of a message type."""
TOPICS = {"/pose": "Pose", "/joints": "Joints", "/events": "Event"}


def write_protobuf(path: Path) -> None:
    """Write the messages as protobuf."""
    files = _files()
    schema = Embedded.from_bytes("protobuf", files.SerializeToString())
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    classes = {
        name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"bench.{name}")) for name in TYPES
    }
    writer = McapWriter(path)
    connections = {
        topic: writer.add_connection(topic, protobuf.read_schema(f"bench.{name}", schema))
        for topic, name in TOPICS.items()
    }
    for time_ns, topic, values in _messages():
        values["stamp"] = {"seconds": time_ns // 10**9, "nanos": time_ns % 10**9}
        writer.write(connections[topic], time_ns, classes[TOPICS[topic]](**values).SerializeToString())
    writer.finish()


def write_json(path: Path) -> None:
    """Write the messages as JSON with a JSON Schema."""
    writer = McapWriter(path)
    connections = {
        topic: writer.add_connection(
            topic, json_schema.read_schema(f"bench.{name}", Embedded("jsonschema", json.dumps(_schema(name))))
        )
        for topic, name in TOPICS.items()
    }
    for time_ns, topic, values in _messages():
        values["stamp"] = {"sec": time_ns // 10**9, "nsec": time_ns % 10**9}
        writer.write(connections[topic], time_ns, json.dumps(values).encode())
    writer.finish()


def _messages() -> Iterator[tuple[int, str, dict[str, Any]]]:
    random = np.random.default_rng(6)
    names = [f"joint_{number}" for number in range(6)]
    topics = list(TOPICS)
    for number in range(MESSAGES):
        topic, (x, y, z, *joints) = topics[number % 3], random.normal(size=15).tolist()
        values: dict[str, Any] = {
            "/pose": {
                "frame_id": "map",
                "position": {"x": x, "y": y, "z": z},
                "orientation": {"x": 0.0, "y": 0.0, "z": joints[0], "w": joints[1]},
            },
            "/joints": {"names": names, "positions": joints[:6], "velocities": joints[6:]},
            "/events": {
                "level": number % 5,
                "source": "planner",
                "text": f"step {number}",
                "is_active": x > 0,
            },
        }[topic]
        yield START_NS + number * STEP_NS, topic, values


def _files() -> FileDescriptorSet:
    files = FileDescriptorSet()
    timestamp_pb2.DESCRIPTOR.CopyToProto(files.file.add())
    file = files.file.add(name="bench.proto", package="bench", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    kinds = {str: F.TYPE_STRING, float: F.TYPE_DOUBLE, int: F.TYPE_INT32, bool: F.TYPE_BOOL}
    for name, fields in TYPES.items():
        message = file.message_type.add(name=name)
        for number, (key, example) in enumerate(fields.items(), 1):
            item = example[0] if isinstance(example, list) else example
            label = F.LABEL_REPEATED if isinstance(example, list) else F.LABEL_OPTIONAL
            field = message.field.add(name=key, number=number, label=label)
            if item == "Time" or item in TYPES:
                field.type = F.TYPE_MESSAGE
                field.type_name = ".google.protobuf.Timestamp" if item == "Time" else f".bench.{item}"
            else:
                field.type = kinds[type(item)]
    return files


def _schema(name: str) -> dict[str, Any]:
    if name == "Time":
        part = {"type": "integer", "minimum": 0}
        return {"type": "object", "properties": {"sec": part, "nsec": part}}
    properties = {key: _property(example) for key, example in TYPES[name].items()}
    return {
        "type": "object",
        "title": f"bench.{name}",
        "properties": properties,
        "required": list(properties),
    }


def _property(example: object) -> dict[str, Any]:
    if isinstance(example, list):
        items: list[object] = example
        return {"type": "array", "items": _property(items[0])}
    if isinstance(example, str) and (example == "Time" or example in TYPES):
        return _schema(example)
    return {"type": {str: "string", float: "number", int: "integer", bool: "boolean"}[type(example)]}
