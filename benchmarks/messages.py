"""Messages of all types in the benchmarks, with values that depend only on the seed."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

Message: TypeAlias = Any
"""An instance of a class that rosbags creates at run time."""
Values: TypeAlias = Any
"""The value of a field: a numpy array or a plain value."""

FRAMES = ("base_link", "camera_front", "camera_rear", "lidar_top", "imu_link", "gripper")
JOINTS = [f"arm_joint_{number}" for number in range(12)]
STATES = ("RUNNING", "IDLE", "PLANNING", "FAULT")


class Messages:
    """A generator of messages: each method takes the time in nanoseconds and returns a message of one type."""

    def __init__(self, store: Stores, seed: int) -> None:
        self.store = get_typestore(store)
        self.is_ros1 = store is Stores.ROS1_NOETIC
        if "tf2_msgs/msg/TFMessage" not in self.store.types:
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
        self.random = np.random.default_rng(seed)
        self.sequence = 0

    def make(self, name: str, /, **values: Values) -> Message:
        """Return a message; values for fields that the distro's type does not have are ignored."""
        kind = self.store.types[name]
        return kind(**{key: value for key, value in values.items() if key in kind.__dataclass_fields__})

    def normal(self, count: int) -> Values:
        return self.random.standard_normal(count)

    def text(self, shortest: int, longest: int) -> str:
        return (
            self.random.integers(97, 123, int(self.random.integers(shortest, longest + 1)), np.uint8)
            .tobytes()
            .decode()
        )

    def header(self, time_ns: int, frame: str) -> Message:
        self.sequence += 1
        stamp = self.make("builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        return self.make("std_msgs/msg/Header", seq=self.sequence, stamp=stamp, frame_id=frame)

    def vector(self, values: Values, name: str = "Vector3") -> Message:
        return self.make(f"geometry_msgs/msg/{name}", **dict(zip("xyz", map(float, values), strict=True)))

    def quaternion(self) -> Message:
        four = self.normal(4)
        four /= np.linalg.norm(four)
        return self.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, four), strict=True)))

    def pose(self) -> Message:
        position = self.vector(self.normal(3) * 10, "Point")
        return self.make("geometry_msgs/msg/Pose", position=position, orientation=self.quaternion())

    def twist(self, _: int = 0) -> Message:
        linear, angular = self.vector(self.normal(3)), self.vector(self.normal(3))
        return self.make("geometry_msgs/msg/Twist", linear=linear, angular=angular)

    def imu(self, time_ns: int) -> Message:
        covariance = np.diag([0.01] * 3).ravel()
        return self.make(
            "sensor_msgs/msg/Imu",
            header=self.header(time_ns, "imu_link"),
            orientation=self.quaternion(),
            orientation_covariance=covariance,
            angular_velocity=self.vector(self.normal(3)),
            angular_velocity_covariance=covariance,
            linear_acceleration=self.vector(self.normal(3) * 3),
            linear_acceleration_covariance=covariance,
        )

    def odometry(self, time_ns: int) -> Message:
        covariance = np.diag([0.02] * 6).ravel()
        pose = self.make("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(), covariance=covariance)
        twist = self.make("geometry_msgs/msg/TwistWithCovariance", twist=self.twist(), covariance=covariance)
        return self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(time_ns, "odom"),
            child_frame_id="base_link",
            pose=pose,
            twist=twist,
        )

    def joints(self, time_ns: int) -> Message:
        values = {name: self.normal(12) for name in ("position", "velocity", "effort")}
        return self.make("sensor_msgs/msg/JointState", header=self.header(time_ns, ""), name=JOINTS, **values)

    def transform(self, time_ns: int, frame: str) -> Message:
        moved = self.make(
            "geometry_msgs/msg/Transform", translation=self.vector(self.normal(3)), rotation=self.quaternion()
        )
        return self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(time_ns, "odom"),
            child_frame_id=frame,
            transform=moved,
        )

    def transforms(self, time_ns: int) -> Message:
        frames = FRAMES[: int(self.random.integers(2, 7))]
        return self.make(
            "tf2_msgs/msg/TFMessage", transforms=[self.transform(time_ns, name) for name in frames]
        )

    def fix(self, time_ns: int) -> Message:
        north, east, up = map(float, self.normal(3))
        return self.make(
            "sensor_msgs/msg/NavSatFix",
            header=self.header(time_ns, "gps"),
            status=self.make("sensor_msgs/msg/NavSatStatus", status=0, service=1),
            latitude=45.46 + north * 1e-4,
            longitude=9.19 + east * 1e-4,
            altitude=120 + up,
            position_covariance=np.diag([0.01] * 3).ravel(),
            position_covariance_type=2,
        )

    def battery(self, time_ns: int) -> Message:
        return self.make(
            "sensor_msgs/msg/BatteryState",
            header=self.header(time_ns, ""),
            voltage=24.1,
            temperature=31.5,
            current=-2.5,
            charge=10.0,
            capacity=20.0,
            design_capacity=20.0,
            percentage=0.7,
            power_supply_status=2,
            power_supply_health=1,
            power_supply_technology=2,
            present=True,
            cell_voltage=np.full(6, 4.01, np.float32),
            cell_temperature=np.full(6, 30.0, np.float32),
            location="slot0",
            serial_number="SN-000123",
        )

    def number(self, _: int) -> Message:
        return self.make("std_msgs/msg/Float64", data=float(self.random.standard_normal()))

    def state(self, time_ns: int) -> Message:
        word = STATES[int(self.random.integers(len(STATES)))]
        return self.make("std_msgs/msg/String", data=f"state={word} t={time_ns}")

    def stamped_pose(self, time_ns: int) -> Message:
        return self.make(
            "geometry_msgs/msg/PoseStamped", header=self.header(time_ns, "map"), pose=self.pose()
        )

    def jpeg(self, time_ns: int) -> Message:
        """Return an image of about 150 kB that is as incompressible as a JPEG image."""
        data = self.random.integers(0, 256, 150_000 + int(self.random.integers(-15_000, 15_000)), np.uint8)
        data[:4], data[-2:] = (0xFF, 0xD8, 0xFF, 0xE0), (0xFF, 0xD9)
        header = self.header(time_ns, "cam")
        return self.make("sensor_msgs/msg/CompressedImage", header=header, format="jpeg", data=data)

    def camera_info(self, time_ns: int) -> Message:
        projection = np.zeros(12)
        projection[[0, 5, 10]] = 600, 600, 1
        matrices = {
            "d": np.array([0.1, -0.2, 0, 0, 0]),
            "k": np.array([600.0, 0, 320, 0, 600, 240, 0, 0, 1]),
            "r": np.eye(3).ravel(),
            "p": projection,
        }
        roi = self.make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(time_ns, "cam"),
            height=480,
            width=640,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=roi,
            **matrices,
            **{name.upper(): value for name, value in matrices.items()},
        )

    def image(self, time_ns: int) -> Message:
        """Return an image of smooth colors with noise in the low bits."""
        rows, columns = np.mgrid[0:480, 0:640]
        ramp = ((columns + rows + time_ns // 10**7) % 256).astype(np.uint8)
        noise = self.random.integers(0, 8, (480, 640, 3), np.uint8)
        pixels = np.stack([ramp, ramp[::-1], ramp[:, ::-1]], -1) ^ noise
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(time_ns, "cam"),
            height=480,
            width=640,
            encoding="rgb8",
            is_bigendian=0,
            step=1920,
            data=pixels.ravel(),
        )

    def cloud(self, time_ns: int, points: int = 60_000) -> Message:
        values = np.empty((points, 4), np.float32)
        values[:, :3] = self.random.standard_normal((points, 3), np.float32) * 20
        values[:, 3] = self.random.integers(0, 256, points)
        fields = [
            self.make("sensor_msgs/msg/PointField", name=name, offset=4 * index, datatype=7, count=1)
            for index, name in enumerate(("x", "y", "z", "intensity"))
        ]
        return self.make(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(time_ns, "lidar"),
            height=1,
            width=points,
            fields=fields,
            is_bigendian=False,
            point_step=16,
            row_step=16 * points,
            data=values.view(np.uint8).ravel(),
            is_dense=True,
        )

    def small_cloud(self, time_ns: int) -> Message:
        return self.cloud(time_ns, 20_000)

    def diagnostics(self, time_ns: int) -> Message:
        status = [
            self.make(
                "diagnostic_msgs/msg/DiagnosticStatus",
                level=int(self.random.integers(0, 3)),
                name=self.text(5, 40),
                message=self.text(0, 30),
                hardware_id=self.text(0, 10),
                values=[
                    self.make("diagnostic_msgs/msg/KeyValue", key=self.text(3, 15), value=self.text(1, 12))
                    for _ in range(int(self.random.integers(0, 8)))
                ],
            )
            for _ in range(int(self.random.integers(1, 12)))
        ]
        return self.make(
            "diagnostic_msgs/msg/DiagnosticArray", header=self.header(time_ns, ""), status=status
        )

    def path(self, time_ns: int) -> Message:
        poses = [self.stamped_pose(time_ns) for _ in range(int(self.random.integers(1, 201)))]
        return self.make("nav_msgs/msg/Path", header=self.header(time_ns, "map"), poses=poses)

    def words(self, _: int) -> Message:
        return self.make("std_msgs/msg/String", data=self.text(1, 200))

    def numbers(self, _: int) -> Message:
        layout = self.make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
        data = self.normal(int(self.random.integers(0, 501)))
        return self.make("std_msgs/msg/Float64MultiArray", layout=layout, data=data)
