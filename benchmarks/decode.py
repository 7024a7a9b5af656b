"""Guards the columnar decoder: how many times faster it is than rosbags and than the row-wise decoder.

Run it as `python benchmarks/decode.py [--scale 0.2]`. Every case decodes one batch whose payloads lie in one buffer, as
they do after a chunk is read. Targets: telemetry 20 times rosbags, DiagnosticArray 4, Path 15; nothing slower than
row by row. rosbags returns views of large arrays, so that for images and clouds it has not yet copied anything.
"""

from __future__ import annotations

import argparse
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from rosbags.typesys import Stores as RosbagsStores
from rosbags.typesys import get_typestore

from mosaico_ingest.decode.decoder import ColumnarDecoder, Decoded, RowwiseDecoder
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.blocks import Encoding, MessageBlock
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.serialization import Serializer

RNG = np.random.default_rng(7)
Values = dict[str, Any]
Make = Callable[[int], Values]


def header(number: int, payloads: str = "base_link") -> Values:
    return {
        "stamp": {"sec": 1_700_000_000 + number // 100, "nanosec": number % 100 * 10_000_000},
        "frame_id": payloads,
    }


def floats(count: int) -> list[float]:
    return RNG.standard_normal(count).tolist()


def vector() -> Values:
    return dict(zip("xyz", floats(3), strict=True))


def quaternion() -> Values:
    return dict(zip("xyzw", floats(4), strict=True))


def pose() -> Values:
    return {"position": vector(), "orientation": quaternion()}


def twist() -> Values:
    return {"linear": vector(), "angular": vector()}


def imu(number: int) -> Values:
    return {
        "header": header(number, "imu_link"),
        "orientation": quaternion(),
        "orientation_covariance": floats(9),
        "angular_velocity": vector(),
        "angular_velocity_covariance": floats(9),
        "linear_acceleration": vector(),
        "linear_acceleration_covariance": floats(9),
    }


def odometry(number: int) -> Values:
    return {
        "header": header(number, "odom"),
        "child_frame_id": "base_link",
        "pose": {"pose": pose(), "covariance": floats(36)},
        "twist": {"twist": twist(), "covariance": floats(36)},
    }


JOINTS = [f"{side}_{part}_joint" for side in ("left", "right") for part in
          ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")]  # fmt: skip


def joint_state(number: int) -> Values:
    arrays = {name: floats(12) for name in ("position", "velocity", "effort")}
    return {"header": header(number), "name": JOINTS, **arrays}


def transform(number: int, payloads: str) -> Values:
    return {
        "header": header(number),
        "child_frame_id": payloads,
        "transform": {"translation": vector(), "rotation": quaternion()},
    }


def transforms(number: int) -> Values:
    return {"transforms": [transform(number, payloads) for payloads in JOINTS[: 2 + number % 5]]}


def any_transforms(number: int) -> Values:
    frames = [text(4, 20) for _ in range(int(RNG.integers(1, 30)))]
    return {"transforms": [transform(number, payloads) for payloads in frames]}


def fix(number: int) -> Values:
    return {
        "header": header(number, "gps"),
        "status": {"status": 0, "service": 1},
        **dict(zip(("latitude", "longitude", "altitude"), floats(3), strict=True)),
        "position_covariance": floats(9),
        "position_covariance_type": 2,
    }


def text(least: int, most: int) -> str:
    return "".join(map(chr, RNG.integers(97, 123, RNG.integers(least, most + 1)).tolist()))


def diagnostics(number: int) -> Values:
    return {
        "header": header(number, ""),
        "status": [
            {
                "level": int(RNG.integers(0, 3)),
                "name": text(5, 40),
                "message": text(0, 30),
                "hardware_id": text(0, 10),
                "values": [
                    {"key": text(3, 15), "value": text(1, 12)} for _ in range(int(RNG.integers(0, 8)))
                ],
            }
            for _ in range(int(RNG.integers(1, 12)))
        ],
    }


def path(number: int) -> Values:
    count = int(RNG.integers(1, 201))
    return {
        "header": header(number),
        "poses": [{"header": header(number), "pose": pose()} for _ in range(count)],
    }


def multi_array(_: int) -> Values:
    data = floats(int(RNG.integers(0, 501)))
    return {"layout": {"dim": [], "data_offset": 0}, "data": data}


def scan(number: int) -> Values:
    names = (
        "angle_min",
        "angle_max",
        "angle_increment",
        "time_increment",
        "scan_time",
        "range_min",
        "range_max",
    )
    return {
        "header": header(number, "laser"),
        **dict.fromkeys(names, 0.5),
        "ranges": floats(1080),
        "intensities": floats(1080),
    }


def cloud(number: int) -> Values:
    points = int(RNG.integers(25_000, 30_001))
    fields = [
        {"name": name, "offset": 4 * place, "datatype": 7, "count": 1} for place, name in enumerate("xyzi")
    ]
    return {
        "header": header(number, "lidar"),
        "height": 1,
        "width": points,
        "fields": fields,
        "is_bigendian": False,
        "point_step": 16,
        "row_step": 16 * points,
        "data": RNG.bytes(16 * points),
        "is_dense": True,
    }


def jpeg(number: int) -> Values:
    return {
        "header": header(number, "camera"),
        "format": "jpeg",
        "data": RNG.bytes(int(RNG.integers(80_000, 120_001))),
    }


def markers(number: int) -> Values:
    marker = {
        "header": header(number), "ns": "objects", "type": 1, "action": 0, "pose": pose(), "scale": vector(),
        "color": dict.fromkeys("rgba", 1.0), "lifetime": {"sec": 0, "nanosec": 0}, "frame_locked": False,
        "points": [], "colors": [], "texture_resource": "", "uv_coordinates": [], "mesh_resource": "",
        "texture": {"header": header(0, ""), "format": "", "data": b""}, "mesh_use_embedded_materials": False,
        "mesh_file": {"filename": "", "data": b""},
    }  # fmt: skip
    return {"markers": [{**marker, "id": place, "text": text(0, 20)} for place in range(1000)]}


CASES: tuple[tuple[str, int, Make, float], ...] = (
    ("sensor_msgs/msg/Imu", 12_000, imu, 20),
    ("nav_msgs/msg/Odometry", 3_000, odometry, 20),
    ("sensor_msgs/msg/JointState", 6_000, joint_state, 20),
    ("tf2_msgs/msg/TFMessage", 3_000, transforms, 20),
    ("sensor_msgs/msg/NavSatFix", 6_000, fix, 20),
    ("std_msgs/msg/Float64", 30_000, lambda _: {"data": float(RNG.random())}, 20),
    ("geometry_msgs/msg/PoseStamped", 10_000, lambda number: {"header": header(number), "pose": pose()}, 20),
    ("std_msgs/msg/String", 5_000, lambda _: {"data": text(1, 200)}, 1),
    ("diagnostic_msgs/msg/DiagnosticArray", 1_000, diagnostics, 4),
    ("nav_msgs/msg/Path", 500, path, 15),
    ("tf2_msgs/msg/TFMessage, any frames", 3_000, any_transforms, 4),
    ("std_msgs/msg/Float64MultiArray", 5_000, multi_array, 0),
    ("sensor_msgs/msg/LaserScan", 2_000, scan, 0),
    ("sensor_msgs/msg/PointCloud2", 100, cloud, 0),
    ("sensor_msgs/msg/CompressedImage", 300, jpeg, 0),
    ("visualization_msgs/msg/MarkerArray", 5, markers, 1),
)
"""Type with its peculiarity, number of messages, function that builds a message, and target speed relative to rosbags (0: none)."""


def joined(payloads: list[bytes]) -> MessageBlock:
    """Return a batch in one buffer, with the 31 bytes of an MCAP record's header between payloads."""
    lengths = np.array(list(map(len, payloads)), np.int64)
    data = np.frombuffer(b"".join(bytes(31) + payload for payload in payloads), np.uint8)
    number = np.arange(len(payloads), dtype=np.int64)
    return MessageBlock(0, number, data, np.cumsum(lengths + 31) - lengths, lengths, number)


def seconds(work: Callable[[], object], repeats: int) -> float:
    """Return the best of some runs, in CPU seconds."""
    best = float("inf")
    for _ in range(repeats):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scale", type=float, default=1.0, help="part of the messages of each case")
    parser.add_argument("--only", default="", help="part of the type's name")
    arguments = parser.parse_args()
    resolver = TypeResolver(Stores.ROS2_HUMBLE)
    store = get_typestore(RosbagsStores.ROS2_HUMBLE)
    print(
        f"{'type':<38}{'messages':>9}{'columnar':>14}{'rosbags':>14}{'row-wise':>14}{'ratio':>9}{'target':>8}"
    )
    for label, full, make, target in CASES:
        if arguments.only not in label:
            continue
        name = label.split(",")[0]
        definition = resolver.resolve(name, None, ros_version=2)
        serializer = Serializer(definition, Encoding.CDR)
        payloads = [
            serializer.from_dict(make(number)) for number in range(max(1, int(full * arguments.scale)))
        ]
        batch, count = joined(payloads), len(payloads)
        columnar, rowwise = (
            ColumnarDecoder(definition, Encoding.CDR),
            RowwiseDecoder(definition, Encoding.CDR),
        )
        recent: deque[Decoded] = deque(
            maxlen=3
        )  # as in a pipeline, memory is used again, not returned and asked for
        fast = count / seconds(lambda: recent.append(columnar.decode(batch)), 12)  # noqa: B023 - called immediately
        peer = count / seconds(lambda: [store.deserialize_cdr(raw, name) for raw in payloads], 2)  # noqa: B023 - called immediately
        slow = count / seconds(lambda: rowwise.decode(batch), 1)  # noqa: B023 - called immediately
        mark = "" if fast >= max(target * peer, slow) else "  MISSED"
        ratio = f"{fast / peer:.1f}x"
        print(
            f"{label:<38}{count:>9,}{fast:>12,.0f}/s{peer:>12,.0f}/s{slow:>12,.0f}/s{ratio:>9}{target:>7}x{mark}"
        )


if __name__ == "__main__":
    main()
