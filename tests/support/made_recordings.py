"""Recordings written from definitions and values."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.blocks import Encoding
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.rosbags_library import open_writer
from mosaico_ingest.rosbag.serialization import Serializer

Message = tuple[str, Definition, int, dict[str, Any]]


def define(msgtype: str, text: str, *, version: int = 2) -> Definition:
    embedded = Embedded(f"ros{version}msg", text)
    return TypeResolver(Stores.EMPTY).resolve(msgtype, embedded, ros_version=version)


def record(path: Path, messages: Iterable[Message]) -> Path:
    """Write messages: topic, definition, log time in ns, values."""
    with open_writer(path) as writer:
        channels: dict[tuple[str, str], int] = {}
        for topic, definition, log_ns, values in messages:
            key = (topic, definition.text)
            if key not in channels:
                channels[key] = writer.add_connection(topic, definition)
            encoding = Encoding.ROS1 if definition.ros_version == 1 else Encoding.CDR
            writer.write(channels[key], log_ns, Serializer(definition, encoding).from_dict(values))
    return path
