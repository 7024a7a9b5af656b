"""`ROSLoader(reader="rosbags")` and the native reader return the same messages of recordings in every container."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mosaico_ingest.errors import BagError
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.blocks import Encoding, ROSMessage
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.loader import ROSLoader
from mosaico_ingest.rosbag.rosbags_library import open_writer
from mosaico_ingest.rosbag.serialization import Serializer

HEADER = {"stamp": {"sec": 7, "nanosec": 8}, "frame_id": "base"}
TYPES = {
    "sensor_msgs/msg/JointState": lambda n: {
        "header": HEADER, "name": [f"joint_{i}" for i in range(n % 4)], "position": [n / 4] * (n % 4),
        "velocity": [], "effort": [float(n)],
    },
    "sensor_msgs/msg/CompressedImage": lambda n: {"header": HEADER, "format": "jpeg", "data": bytes(range(n))},
    "std_msgs/msg/String": lambda n: {"data": f"number {n}, ü"},
    "std_msgs/msg/Bool": lambda n: {"data": n % 2 == 0},
    "std_msgs/msg/Empty": lambda _: {},
    "diagnostic_msgs/msg/KeyValue": lambda n: {"key": str(n), "value": ""},
}  # fmt: skip


def write(path: Path, distro: Stores) -> Path:
    """Write 20 messages of each type to a container that stores messages of the distro's ROS version."""
    version = 1 if distro is Stores.ROS1_NOETIC else 2
    encoding = Encoding.ROS1 if version == 1 else Encoding.CDR
    with open_writer(path) as writer:
        channels = []
        for msgtype, values_of in TYPES.items():
            definition = TypeResolver(distro).resolve(msgtype, None, ros_version=version)
            topic = "/" + msgtype.rpartition("/")[2].lower()
            serializer = Serializer(definition, encoding)
            channels.append((writer.add_connection(topic, definition), definition, serializer, values_of))
        for number in range(20):
            for connection, definition, serializer, values_of in channels:
                values: dict[str, Any] = values_of(number)
                if version == 1 and "header" in values:
                    values = {**values, "header": {"seq": number, **HEADER}}
                writer.write(connection, 1_000 * number, serializer.from_dict(values))
                assert definition.root
    return path


def key(item: tuple[ROSMessage, Exception | None]) -> tuple[int, str]:
    return item[0].timestamp_ns, item[0].topic


@pytest.mark.parametrize(
    ("name", "distro"),
    [
        ("a.bag", Stores.ROS1_NOETIC),
        ("a.db3", Stores.ROS2_HUMBLE),
        ("a.mcap", Stores.ROS2_HUMBLE),
    ],
)
def test_loader_both_readers_return_equal_messages(tmp_path: Path, name: str, distro: Stores) -> None:
    path = write(tmp_path / name, distro)
    with ROSLoader(path, reader="native") as native, ROSLoader(path, reader="rosbags") as reference:
        assert native.topics == reference.topics
        assert native.msg_types == reference.msg_types
        assert native.msg_count() == reference.msg_count() == 20 * len(TYPES)
        assert native.duration == reference.duration
        assert sorted(native, key=key) == sorted(reference, key=key)
        assert not reference.rejected


def test_rosbags_reader_selected_topic_yields_only_its_messages(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", Stores.ROS2_HUMBLE)
    with ROSLoader(path, topics="/string", reader="rosbags") as loader:
        assert {message.topic for message, _ in loader} == {"/string"}


def test_rosbags_reader_damaged_file_raises(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", Stores.ROS2_HUMBLE)
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(BagError, match="rosbags cannot open the recording"):
        ROSLoader(path, reader="rosbags")


def test_loader_unknown_reader_raises(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", Stores.ROS2_HUMBLE)
    with pytest.raises(BagError, match="unknown reader 'native2'"):
        ROSLoader(path, reader="native2")  # type: ignore[arg-type]


def test_rosbags_reader_invalid_payload_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    definition = TypeResolver(Stores.ROS2_HUMBLE).resolve("std_msgs/msg/String", None, ros_version=2)
    with open_writer(path) as writer:
        connection = writer.add_connection("/text", definition)
        writer.write(connection, 1, np.frombuffer(b"\0\1\0\0\xff\0\0\0abc", np.uint8).tobytes())
    with ROSLoader(path, error_policy="ignore", reader="rosbags") as loader:
        assert all(error is not None for _, error in loader)
        assert loader.rejected == {"/text": 1}
