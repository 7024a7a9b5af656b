"""The sequences of NVIDIA's R2B data sets as far as public sources describe them, and the parameters of their stand-ins.

Every value is `known` (a public source states it), `derived` (computed from known values) or `assumed` (not known; the stand-in
needs a value). docs/r2b.md lists the sources.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Evidence(Enum):
    """How reliable a value is."""

    KNOWN = "known"
    DERIVED = "derived"
    ASSUMED = "assumed"


KNOWN, DERIVED, ASSUMED = Evidence
FRAMES = 30.0
"""Frames per second of every camera, according to the table of `ros2_benchmark`, unless noted otherwise."""


@dataclass(frozen=True)
class Topic:
    """A topic of a sequence."""

    name: str
    kind: str
    """The name of the message type without package, or an image encoding with its size."""
    hertz: float
    rate: Evidence = KNOWN
    count: int | None = None
    """Number of messages, if it is known."""
    evidence: Evidence = KNOWN
    """Whether the topic exists under this name with this type."""


@dataclass(frozen=True)
class Sequence:
    """A sequence, with the size and the duration of its recording."""

    name: str
    year: int
    file_bytes: int
    size: Evidence
    seconds: float
    duration: Evidence
    topics: tuple[Topic, ...]
    note: str

    @property
    def file(self) -> str:
        """The path of its recording below the folder of the data sets."""
        if self.year == 2024:
            return f"{self.name}/{self.name}_0.mcap"
        return f"{self.name}/{self.name}{'' if self.name == 'r2b_hope' else '_0'}.db3"


def _hawk(
    place: str, frames: tuple[int | None, int | None], infos: int | None, evidence: Evidence
) -> list[Topic]:
    """Return the topics of a stereo camera of the Nova rig."""
    topics: list[Topic] = []
    for side, count in zip(("left", "right"), frames, strict=True):
        base = f"/{place}_stereo_camera/{side}"
        topics += [
            Topic(f"{base}/camera_info", "CameraInfo", FRAMES, count=infos, evidence=evidence),
            Topic(f"{base}/image_compressed", "CompressedImage", FRAMES, count=count, evidence=evidence),
        ]
    return topics


NOVA_COUNTS = {
    "back": ((525, 490), 564),
    "front": ((521, 515), 562),
    "left": ((513, 498), 527),
    "right": ((488, 488), 488),
}
"""Messages per stereo camera of r2b_whitetunnel: (left, right) images, and camera infos of each side."""
WHITETUNNEL = (
    *(topic for place, counts in NOVA_COUNTS.items() for topic in _hawk(place, *counts, evidence=KNOWN)),
    Topic("/chassis/battery_state", "BatteryState", 27 / 18.8, DERIVED, 27),
    Topic("/chassis/imu", "Imu", 1080 / 18.8, DERIVED, 1080),
    Topic("/chassis/odom", "Odometry", 1080 / 18.8, DERIVED, 1080),
    Topic("/chassis/ticks", "EncoderTicks", 1081 / 18.8, DERIVED, 1081),
    Topic("/front_stereo_imu/imu", "Imu", 1761 / 18.8, DERIVED, 1761),
    Topic("/tf", "TFMessage", 4282 / 18.8, DERIVED, 4282),
    Topic("/tf_static", "TFMessage", 0, KNOWN, 1),
)
GALILEO = (
    *(topic for place in NOVA_COUNTS for topic in _hawk(place, (None, None), None, evidence=ASSUMED)),
    Topic("/chassis/battery_state", "BatteryState", 27 / 18.8, ASSUMED, evidence=ASSUMED),
    Topic("/chassis/imu", "Imu", 1080 / 18.8, ASSUMED, evidence=ASSUMED),
    Topic("/chassis/odom", "Odometry", 1080 / 18.8, ASSUMED, evidence=ASSUMED),
    Topic("/chassis/ticks", "EncoderTicks", 1081 / 18.8, ASSUMED),
    Topic("/front_stereo_imu/imu", "Imu", 1761 / 18.8, ASSUMED, evidence=ASSUMED),
    Topic("/tf", "TFMessage", 4282 / 18.8, ASSUMED, evidence=ASSUMED),
    Topic("/tf_static", "TFMessage", 0, ASSUMED, 1),
)
GALILEO2 = (
    Topic("/camera/color/image_raw", "rgb8 1280x800", 15),
    Topic("/camera/color/camera_info", "CameraInfo", 15, ASSUMED, evidence=ASSUMED),
    Topic("/camera/realsense_splitter_node/output/depth", "16UC1 1280x720", FRAMES),
    Topic("/camera/depth/camera_info", "CameraInfo", FRAMES, ASSUMED, evidence=ASSUMED),
    Topic("/camera/realsense_splitter_node/output/infra_1", "mono8 1280x720", FRAMES, evidence=ASSUMED),
    Topic("/camera/infra1/camera_info", "CameraInfo", FRAMES, ASSUMED, evidence=ASSUMED),
    Topic("/camera/realsense_splitter_node/output/infra_2", "mono8 1280x720", FRAMES, evidence=ASSUMED),
    Topic("/camera/infra2/camera_info", "CameraInfo", FRAMES, ASSUMED, evidence=ASSUMED),
    Topic("/chassis/imu", "Imu", 60, ASSUMED, evidence=ASSUMED),
    Topic("/chassis/odom", "Odometry", 60, ASSUMED, evidence=ASSUMED),
    Topic("/tf_static", "TFMessage", 0, ASSUMED, 1, evidence=ASSUMED),
)
ROBOTARM = (
    Topic("/camera_1/color/image_raw", "rgb8 1280x720", FRAMES),
    Topic("/camera_1/color/camera_info", "CameraInfo", FRAMES),
    Topic("/camera_1/aligned_depth_to_color/image_raw", "16UC1 1280x720", FRAMES),
    Topic("/camera_1/aligned_depth_to_color/camera_info", "CameraInfo", FRAMES),
    Topic("/joint_states", "JointState", 200, ASSUMED),
    Topic("/tf", "TFMessage", 200, ASSUMED, evidence=ASSUMED),
)
RIG_2023 = (
    Topic("d455_1_rgb_image", "rgb8 1280x720", FRAMES),
    Topic("d455_1_rgb_camera_info", "CameraInfo", FRAMES),
    Topic("d455_1_depth_image", "32FC1 1280x720", FRAMES),
    Topic("d455_1_depth_camera_info", "CameraInfo", FRAMES),
    Topic("d455_1_left_ir_image", "mono8 1280x720", FRAMES),
    Topic("d455_1_left_ir_camera_info", "CameraInfo", FRAMES),
    Topic("d455_1_right_ir_image", "mono8 1280x720", FRAMES),
    Topic("d455_1_right_ir_camera_info", "CameraInfo", FRAMES, evidence=ASSUMED),
    Topic("hawk_0_left_rgb_image", "rgb8 1920x1200", FRAMES),
    Topic("hawk_0_left_rgb_camera_info", "CameraInfo", FRAMES),
    Topic("hawk_0_right_rgb_image", "rgb8 1920x1200", FRAMES),
    Topic("hawk_0_right_rgb_camera_info", "CameraInfo", FRAMES),
    Topic("pandar_xt_32_0_lidar", "PointCloud2", 10),
    Topic("/tf_static", "TFMessage", 0, KNOWN, 1),
)
CAFE_BYTES, CAFE_SECONDS = 1_212_297_216, 5.0


def _rig_2023(name: str, file_bytes: int, size: Evidence, note: str) -> Sequence:
    """Return a sequence of the rig of 2023, whose duration is derived from the one of r2b_cafe by size."""
    seconds = CAFE_SECONDS * file_bytes / CAFE_BYTES
    duration = KNOWN if name == "r2b_cafe" else DERIVED
    return Sequence(name, 2023, file_bytes, size, seconds, duration, RIG_2023, note)


SEQUENCES = (
    Sequence(
        "r2b_galileo", 2024, 493_000_000, KNOWN, 22.0, KNOWN, GALILEO, "H.264 video of four stereo cameras"
    ),
    Sequence(
        "r2b_galileo2", 2024, 986 << 20, KNOWN, 6.6, DERIVED, GALILEO2, "raw images of a RealSense D455"
    ),
    Sequence(
        "r2b_robotarm", 2024, 1_496_918_907, KNOWN, 10.8, DERIVED, ROBOTARM, "raw images and joint states"
    ),
    Sequence(
        "r2b_whitetunnel",
        2024,
        527_000_000,
        KNOWN,
        18.8,
        DERIVED,
        WHITETUNNEL,
        "H.264 video of four stereo cameras",
    ),
    _rig_2023("r2b_lounge", 39 * (1 << 30) // 10, KNOWN, "staircase and plants"),
    _rig_2023("r2b_storage", 3_087_908_864, KNOWN, "shelves, boxes and AprilTags"),
    _rig_2023("r2b_hallway", 1_354_493_952, KNOWN, "walking persons"),
    _rig_2023("r2b_datacenter", 1_815_089_152, KNOWN, "repetitive surfaces"),
    _rig_2023("r2b_cafe", CAFE_BYTES, KNOWN, "reflective floor"),
    Sequence(
        "r2b_hope",
        2023,
        31_162_368,
        KNOWN,
        5.0,
        ASSUMED,
        (Topic("/image", "bgr8 1920x1080", 1, ASSUMED, 5),),
        "five images, not compressed",
    ),
    _rig_2023("r2b_hideaway", 1_913_946_112, KNOWN, "seated persons"),
    _rig_2023("r2b_mezzanine", 2_057_437_184, KNOWN, "staircase and railings"),
)
BY_NAME = {sequence.name: sequence for sequence in SEQUENCES}
