"""Recordings for the benchmarks: generated once with fixed seeds, about 2 GB in `benchmarks/data`."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from encodings_mcap import write_json, write_protobuf
from messages import Message, Messages, Values
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores

Writer: TypeAlias = Ros1Writer | Ros2Writer

START_NS = 1_700_000_000_000_000_000

Make = Callable[[Messages, int], Message]


@dataclass(frozen=True)
class Topic:
    """A topic with its message type, its rate, and its duration if it is shorter than the recording."""

    name: str
    msgtype: str
    hertz: float
    make: Make
    seconds: float | None = None


TELEMETRY = (
    Topic("/imu/front", "sensor_msgs/msg/Imu", 400, Messages.imu),
    Topic("/imu/rear", "sensor_msgs/msg/Imu", 400, Messages.imu),
    Topic("/odom", "nav_msgs/msg/Odometry", 100, Messages.odometry),
    Topic("/joint_states", "sensor_msgs/msg/JointState", 200, Messages.joints),
    Topic("/tf", "tf2_msgs/msg/TFMessage", 100, Messages.transforms),
    Topic("/gps/fix", "sensor_msgs/msg/NavSatFix", 10, Messages.fix),
    Topic("/battery", "sensor_msgs/msg/BatteryState", 1, Messages.battery),
    Topic("/load", "std_msgs/msg/Float64", 1000, Messages.number),
    Topic("/state", "std_msgs/msg/String", 5, Messages.state),
    Topic("/pose", "geometry_msgs/msg/PoseStamped", 50, Messages.stamped_pose),
    Topic("/cmd_vel", "geometry_msgs/msg/Twist", 50, Messages.twist),
)
LIDAR = (
    Topic("/lidar/points", "sensor_msgs/msg/PointCloud2", 10, Messages.cloud),
    Topic("/imu", "sensor_msgs/msg/Imu", 200, Messages.imu),
)
MIXED = (
    *(Topic(t.name, t.msgtype, t.hertz / 2 if t.hertz >= 100 else t.hertz, t.make) for t in TELEMETRY),
    Topic("/cam/left/compressed", "sensor_msgs/msg/CompressedImage", 10, Messages.jpeg),
    Topic("/cam/left/camera_info", "sensor_msgs/msg/CameraInfo", 10, Messages.camera_info),
    Topic("/cam/left/image_raw", "sensor_msgs/msg/Image", 2, Messages.image),
    Topic("/lidar/points", "sensor_msgs/msg/PointCloud2", 2, Messages.small_cloud),
)
LAYOUTS = (
    Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", 100, Messages.diagnostics),
    Topic("/plan", "nav_msgs/msg/Path", 20, Messages.path),
    Topic("/log", "std_msgs/msg/String", 500, Messages.words),
    Topic("/values", "std_msgs/msg/Float64MultiArray", 200, Messages.numbers),
)


def cameras(raw_seconds: float) -> tuple[Topic, ...]:
    return (
        Topic("/cam/left/compressed", "sensor_msgs/msg/CompressedImage", 30, Messages.jpeg),
        Topic("/cam/right/compressed", "sensor_msgs/msg/CompressedImage", 30, Messages.jpeg),
        Topic("/cam/left/camera_info", "sensor_msgs/msg/CameraInfo", 30, Messages.camera_info),
        Topic("/cam/left/image_raw", "sensor_msgs/msg/Image", 15, Messages.image, raw_seconds),
    )


@dataclass(frozen=True)
class Workload:
    """A recording with the targets of its measurement."""

    name: str
    topics: tuple[Topic, ...]
    seconds: float
    seed: int
    suffix: str = ".mcap"
    compression: str = "zstd"
    peer: str | None = None
    """The shorter recording that the official injector ingests, if this one would take it minutes."""
    min_peer_ratio: float = 0.0
    """The minimum speed relative to the official injector; 0: no target."""
    max_floor_ratio: float = 0.0
    """The maximum time relative to the floor; 0: no target."""
    write: Callable[[Path], None] | None = None
    """Writes the recording, if its messages are not from ROS."""

    def path(self, folder: Path) -> Path:
        """Return the path of the recording, and generate it if it does not exist."""
        target = folder / f"{self.name}{self.suffix}"
        if not target.exists():
            folder.mkdir(parents=True, exist_ok=True)
            unfinished = folder / f"new-{target.name}"
            unfinished.unlink(missing_ok=True)
            if self.write is not None:
                self.write(unfinished)
            else:
                (_write_ros1 if self.suffix == ".bag" else _write_ros2)(self, unfinished)
            unfinished.rename(target)
        return target


WORKLOADS = (
    Workload("telemetry", TELEMETRY, 300, 1, peer="telemetry-30s", min_peer_ratio=100, max_floor_ratio=1.5),
    Workload("cameras", cameras(20), 40, 2, peer="cameras-8s", min_peer_ratio=10, max_floor_ratio=1.5),
    Workload("lidar", LIDAR, 60, 3, peer="lidar-6s", min_peer_ratio=8, max_floor_ratio=1.5),
    Workload("mixed", MIXED, 20, 4, min_peer_ratio=20, max_floor_ratio=2),
    Workload("mixed-sqlite", MIXED, 20, 4, ".db3", "none", min_peer_ratio=20, max_floor_ratio=2),
    Workload("mixed-ros1", MIXED, 20, 4, ".bag", "none", min_peer_ratio=20, max_floor_ratio=2),
    Workload("mixed-ros1-lz4", MIXED, 20, 4, ".bag", "lz4", min_peer_ratio=20, max_floor_ratio=2),
    Workload("layouts", LAYOUTS, 30, 5, min_peer_ratio=20),
    Workload("protobuf", (), 100, 6, min_peer_ratio=10, write=write_protobuf),
    Workload("json", (), 100, 6, min_peer_ratio=10, write=write_json),
)
SHORT = (
    Workload("telemetry-30s", TELEMETRY, 30, 1),
    Workload("cameras-8s", cameras(4), 8, 2),
    Workload("lidar-6s", LIDAR, 6, 3),
)
LONG = (
    Workload(
        "telemetry-1200s", TELEMETRY, 1200, 1, peer="telemetry-30s", min_peer_ratio=100, max_floor_ratio=1.5
    ),
    Workload("mixed-100s", MIXED, 100, 4, peer="mixed", min_peer_ratio=20, max_floor_ratio=2),
    Workload("mixed-sqlite-100s", MIXED, 100, 4, ".db3", "none", "mixed-sqlite", 20, 2),
    Workload("mixed-ros1-100s", MIXED, 100, 4, ".bag", "none", "mixed-ros1", 20, 2),
    Workload("layouts-150s", LAYOUTS, 150, 5, peer="layouts", min_peer_ratio=20),
)
"""Longer recordings, to measure without the influence of start-up and to check that memory does not grow."""
BY_NAME = {workload.name: workload for workload in (*WORKLOADS, *SHORT, *LONG)}


def _schedule(workload: Workload) -> list[list[int]]:
    """Return the time and the topic number of every message, in order of time."""
    topics: list[Values] = []
    for number, topic in enumerate(workload.topics):
        count = int((topic.seconds or workload.seconds) * topic.hertz)
        times = START_NS + (np.arange(count) * (1e9 / topic.hertz)).astype(np.int64) + number * 1000
        topics.append(np.stack([times, np.full(count, number)], axis=1))
    events = np.concatenate(topics)
    return events[np.argsort(events[:, 0], kind="stable")].tolist()


def _fill(writer: Writer, messages: Messages, workload: Workload) -> None:
    connections = [
        writer.add_connection(topic.name, topic.msgtype, typestore=messages.store)
        for topic in workload.topics
    ]
    write = messages.store.serialize_ros1 if messages.is_ros1 else messages.store.serialize_cdr
    for time_ns, number in _schedule(workload):
        topic = workload.topics[number]
        payload = write(topic.make(messages, time_ns), topic.msgtype)
        writer.write(connections[number], time_ns + 50_000, payload)


def _write_ros2(workload: Workload, target: Path) -> None:
    folder = target.with_suffix(".folder")
    shutil.rmtree(folder, ignore_errors=True)
    plugin = StoragePlugin.MCAP if workload.suffix == ".mcap" else StoragePlugin.SQLITE3
    writer = Ros2Writer(folder, version=9, storage_plugin=plugin)
    if workload.compression == "zstd":
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        _fill(writer, Messages(Stores.ROS2_HUMBLE, workload.seed), workload)
    next(folder.glob(f"*{workload.suffix}")).rename(target)
    shutil.rmtree(folder)


def _write_ros1(workload: Workload, target: Path) -> None:
    target.unlink(missing_ok=True)
    writer = Ros1Writer(target)
    if workload.compression == "lz4":
        writer.set_compression(Ros1Writer.CompressionFormat.LZ4)
    with writer:
        _fill(writer, Messages(Stores.ROS1_NOETIC, workload.seed), workload)
