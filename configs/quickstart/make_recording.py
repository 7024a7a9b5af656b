"""Write drive.mcap: ten seconds of a small robot that drives a circle. The messages are the same on every run.

Usage: python configs/quickstart/make_recording.py [OUT.mcap]
"""

from __future__ import annotations

import math
import shutil
import sys
import tempfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from struct import pack
from typing import Any

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

HERE = Path(__file__).parent
START_NS = 1_767_225_600_000_000_000  # 2026-01-01T00:00:00Z
SECONDS = 10
RADIUS_M = 5.0
TURN_RATE = 2 * math.pi / SECONDS
BATTERY = "acme_msgs/msg/BatteryPack"

STORE = get_typestore(Stores.ROS2_HUMBLE)
for definition in sorted((HERE / "acme_msgs").glob("*.msg")):
    STORE.register(get_types_from_msg(definition.read_text(), f"acme_msgs/msg/{definition.stem}"))


def make(msgtype: str, **fields: Any) -> Any:
    return STORE.types[msgtype](**fields)


def header(t_ns: int, frame: str) -> Any:
    stamp = make("builtin_interfaces/msg/Time", sec=t_ns // 10**9, nanosec=t_ns % 10**9)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def vector(x: float, y: float, z: float, kind: str = "Vector3") -> Any:
    return make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


def yaw(angle: float) -> Any:
    return make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(angle / 2), w=math.cos(angle / 2))


def position(t_ns: int) -> tuple[float, float, float]:
    """Return x and y in meters and the heading in radians."""
    angle = TURN_RATE * (t_ns - START_NS) / 1e9
    return RADIUS_M * math.cos(angle), RADIUS_M * math.sin(angle), angle + math.pi / 2


def imu(t_ns: int, noise: np.random.Generator) -> Any:
    cov = np.diag([1e-4] * 3).ravel()
    deviation = noise.normal(0, 0.02, 3)
    return make(
        "sensor_msgs/msg/Imu",
        header=header(t_ns, "imu_link"),
        orientation=yaw(position(t_ns)[2]),
        orientation_covariance=cov,
        angular_velocity=vector(0.0, 0.0, TURN_RATE + deviation[0] * 0.1),
        angular_velocity_covariance=cov,
        linear_acceleration=vector(deviation[1], RADIUS_M * TURN_RATE**2 + deviation[2], 9.81),
        linear_acceleration_covariance=cov,
    )


def odometry(t_ns: int, _noise: np.random.Generator) -> Any:
    x, y, heading = position(t_ns)
    cov = np.diag([0.01] * 6).ravel()
    pose = make("geometry_msgs/msg/Pose", position=vector(x, y, 0.0, "Point"), orientation=yaw(heading))
    twist = make(
        "geometry_msgs/msg/Twist",
        linear=vector(RADIUS_M * TURN_RATE, 0.0, 0.0),
        angular=vector(0.0, 0.0, TURN_RATE),
    )
    return make(
        "nav_msgs/msg/Odometry",
        header=header(t_ns, "odom"),
        child_frame_id="base_link",
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=cov),
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=cov),
    )


def fix(t_ns: int, noise: np.random.Generator) -> Any:
    x, y, _ = position(t_ns)
    return make(
        "sensor_msgs/msg/NavSatFix",
        header=header(t_ns, "gps"),
        status=make("sensor_msgs/msg/NavSatStatus", status=0, service=1),
        latitude=45.4642 + y / 111_320 + noise.normal(0, 1e-6),
        longitude=9.19 + x / 78_000 + noise.normal(0, 1e-6),
        altitude=122.0,
        position_covariance=np.diag([1.0, 1.0, 4.0]).ravel(),
        position_covariance_type=2,
    )


def transforms(t_ns: int, _noise: np.random.Generator) -> Any:
    x, y, heading = position(t_ns)
    transform = make("geometry_msgs/msg/Transform", translation=vector(x, y, 0.0), rotation=yaw(heading))
    stamped = make(
        "geometry_msgs/msg/TransformStamped",
        header=header(t_ns, "odom"),
        child_frame_id="base_link",
        transform=transform,
    )
    return make("tf2_msgs/msg/TFMessage", transforms=[stamped])


def joints(t_ns: int, _noise: np.random.Generator) -> Any:
    wheel_angle = 12.0 * (t_ns - START_NS) / 1e9
    return make(
        "sensor_msgs/msg/JointState",
        header=header(t_ns, ""),
        name=["left_wheel", "right_wheel"],
        position=np.array([wheel_angle, wheel_angle * 1.1]),
        velocity=np.array([12.0, 13.2]),
        effort=np.array([0.4, 0.5]),
    )


def ball_image(t_ns: int) -> np.ndarray:
    """Return a 64 x 48 rgb8 image of a ball that moves on a circle."""
    x, y, _ = position(t_ns)
    rows, columns = np.mgrid[0:48, 0:64]
    distance = (columns - 32 - 4 * x) ** 2 + (rows - 24 - 3 * y) ** 2
    image = np.stack([rows * 4, columns * 3, np.full((48, 64), 90)], axis=-1).astype(np.uint8)
    image[distance < 25] = (250, 200, 40)
    return image


def image(t_ns: int, _noise: np.random.Generator) -> Any:
    return make(
        "sensor_msgs/msg/Image",
        header=header(t_ns, "camera"),
        height=48,
        width=64,
        encoding="rgb8",
        is_bigendian=0,
        step=192,
        data=ball_image(t_ns).ravel(),
    )


def png(pixels: np.ndarray) -> bytes:
    """Return an rgb8 image as PNG."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return pack(">I", len(body)) + kind + body + pack(">I", zlib.crc32(kind + body))

    height, width, _ = pixels.shape
    lines = b"".join(b"\0" + row.tobytes() for row in pixels)
    head = pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(lines))
        + chunk(b"IEND", b"")
    )


def compressed(t_ns: int, _noise: np.random.Generator) -> Any:
    data = np.frombuffer(png(ball_image(t_ns)), np.uint8)
    return make(
        "sensor_msgs/msg/CompressedImage",
        header=header(t_ns, "camera"),
        format="rgb8; png compressed",
        data=data,
    )


def camera_info(t_ns: int, _noise: np.random.Generator) -> Any:
    return make(
        "sensor_msgs/msg/CameraInfo",
        header=header(t_ns, "camera"),
        height=48,
        width=64,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=np.array([60.0, 0, 32, 0, 60, 24, 0, 0, 1]),
        r=np.eye(3).ravel(),
        p=np.array([60.0, 0, 32, 0, 0, 60, 24, 0, 0, 0, 1, 0]),
        binning_x=0,
        binning_y=0,
        roi=make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        ),
    )


def cloud(t_ns: int, noise: np.random.Generator) -> Any:
    angles = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    distance = 8 + np.sin(3 * angles) + noise.normal(0, 0.01, 180)
    points = np.zeros((180, 4), "<f4")
    points[:, 0], points[:, 1], points[:, 3] = distance * np.cos(angles), distance * np.sin(angles), 100
    fields = [
        make("sensor_msgs/msg/PointField", name=name, offset=4 * i, datatype=7, count=1)
        for i, name in enumerate(("x", "y", "z", "intensity"))
    ]
    return make(
        "sensor_msgs/msg/PointCloud2",
        header=header(t_ns, "lidar"),
        height=1,
        width=180,
        fields=fields,
        is_bigendian=False,
        point_step=16,
        row_step=16 * 180,
        data=points.view(np.uint8).ravel(),
        is_dense=True,
    )


def battery(t_ns: int, noise: np.random.Generator) -> Any:
    charge = 80 - (t_ns - START_NS) // 10**9
    cells = [
        make(
            "acme_msgs/msg/Cell", voltage_mv=4000 - 2 * i + int(noise.integers(0, 3)), temperature_dc=251 + i
        )
        for i in range(6)
    ]
    return make(
        BATTERY,
        header=header(t_ns, "base_link"),
        voltage_mv=sum(cell.voltage_mv for cell in cells),
        current_ma=2400,
        soc=int(charge),
        status=2,
        cells=cells,
        serial="PK-0042",
    )


Maker = Callable[[int, np.random.Generator], Any]
TOPICS: tuple[tuple[str, str, int, Maker], ...] = (
    ("/imu", "sensor_msgs/msg/Imu", 100, imu),
    ("/odom", "nav_msgs/msg/Odometry", 20, odometry),
    ("/gps/fix", "sensor_msgs/msg/NavSatFix", 5, fix),
    ("/tf", "tf2_msgs/msg/TFMessage", 20, transforms),
    ("/joint_states", "sensor_msgs/msg/JointState", 50, joints),
    ("/camera/image_raw", "sensor_msgs/msg/Image", 2, image),
    ("/camera/image_raw/compressed", "sensor_msgs/msg/CompressedImage", 5, compressed),
    ("/camera/camera_info", "sensor_msgs/msg/CameraInfo", 5, camera_info),
    ("/lidar/points", "sensor_msgs/msg/PointCloud2", 5, cloud),
    ("/battery", BATTERY, 1, battery),
)


def schedule() -> Iterator[tuple[int, int]]:
    """Yield the header stamp and the topic number of each message, in order of time."""
    times = [
        (START_NS + step * 10**9 // rate + 1000 * number, number)
        for number, (_, _, rate, _) in enumerate(TOPICS)
        for step in range(SECONDS * rate)
    ]
    yield from sorted(times)


def write(out: Path) -> None:
    noise = np.random.default_rng(7)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "bag"
        writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            connections = [
                writer.add_connection(topic, kind, typestore=STORE) for topic, kind, _, _ in TOPICS
            ]
            for t_ns, number in schedule():
                _, kind, _, maker = TOPICS[number]
                message = STORE.serialize_cdr(maker(t_ns, noise), kind)
                writer.write(connections[number], t_ns + 50_000, message)
        shutil.move(next(folder.glob("*.mcap")), out)


if __name__ == "__main__":
    write(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "drive.mcap")
