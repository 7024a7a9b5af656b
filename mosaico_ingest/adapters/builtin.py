"""This file is the list of built-in adapters, readable without opening their files in `catalog/`.

What the files say is also in `catalog.json`: reading that takes a twentieth of the time, and places are rarely asked for.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.adapters.adapter import Adapter
from mosaico_ingest.adapters.mapping.loader import MappingSpec, adapter_from_model
from mosaico_ingest.rosbag.definitions.model import Definition

__all__ = ["BUILTIN", "BY_NAME", "BY_TYPE", "CATALOG", "CATALOG_FILE", "Builtin", "find_builtin"]

CATALOG = Path(__file__).parent / "catalog"
CATALOG_FILE = CATALOG.with_suffix(".json")


class Builtin(Struct, frozen=True):
    """An adapter of the catalog; its file is read when it is first bound."""

    name: str
    stem: str
    """Its file's name, without `.yaml`."""
    tag: str
    """The ontology its rows become."""
    ros_types: tuple[str, ...]
    default: bool = True

    @property
    def path(self) -> Path:
        """Its file."""
        return CATALOG / f"{self.stem}.yaml"

    @property
    def mapping(self) -> MappingSpec:
        """What its file says."""
        return _load(self.stem)

    def bind(self, definition: Definition, shape: pa.StructType) -> Adapter:
        """Check the mapping against the definition and make it ready."""
        return self.mapping.bind(definition, shape)


@cache
def _load(stem: str) -> MappingSpec:
    return adapter_from_model(_values()[stem], CATALOG / f"{stem}.yaml", adapters=find_builtin)


@cache
def _values() -> dict[str, Any]:
    return json.loads(CATALOG_FILE.read_bytes(), object_hook=_mapping)


def _mapping(read: dict[str, Any]) -> dict[Any, Any]:
    """Return a mapping as YAML has it: one with keys that are no text is in the file as pairs."""
    return dict(read[""]) if "" in read else read


class _BuiltinLookup(Struct, frozen=True):
    """Finds built-in adapters by name, for the mappings that use them."""

    def __call__(self, name: str) -> Builtin | None:
        return BY_NAME.get(name)

    def names(self) -> Iterable[str]:
        return BY_NAME


find_builtin = _BuiltinLookup()


BUILTIN: tuple[Builtin, ...] = (
    Builtin(
        "AccelAdapter",
        "accel",
        "Acceleration",
        (
            "geometry_msgs/msg/Accel",
            "geometry_msgs/msg/AccelStamped",
            "geometry_msgs/msg/AccelWithCovariance",
            "geometry_msgs/msg/AccelWithCovarianceStamped",
        ),
    ),
    Builtin("BatteryStateAdapter", "battery_state", "BatteryState", ("sensor_msgs/msg/BatteryState",)),
    Builtin("BooleanStdAdapter", "boolean", "Boolean", ("std_msgs/msg/Bool", "example_interfaces/msg/Bool")),
    Builtin("CameraInfoAdapter", "camera_info", "CameraInfo", ("sensor_msgs/msg/CameraInfo",)),
    Builtin(
        "CompressedImageAdapter", "compressed_image", "CompressedImage", ("sensor_msgs/msg/CompressedImage",)
    ),
    Builtin(
        "CompressedVideoAdapter",
        "compressed_video",
        "CompressedImage",
        ("foxglove_msgs/msg/CompressedVideo",),
    ),
    Builtin(
        "DurationAdapter",
        "duration",
        "Duration",
        ("builtin_interfaces/msg/Duration", "std_msgs/msg/Duration"),
    ),
    Builtin(
        "Floating32StdAdapter",
        "floating32",
        "Floating32",
        ("std_msgs/msg/Float32", "example_interfaces/msg/Float32"),
    ),
    Builtin(
        "Floating64StdAdapter",
        "floating64",
        "Floating64",
        ("std_msgs/msg/Float64", "example_interfaces/msg/Float64"),
    ),
    Builtin(
        "FrameTransformAdapter",
        "frame_transform",
        "FrameTransform",
        ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"),
    ),
    Builtin("GPSAdapter", "gps", "GPS", ("sensor_msgs/msg/NavSatFix",)),
    Builtin(
        "GPSFixAdapter", "gps_fix", "GPS", ("gps_msgs/msg/GPSFix", "gps_common/msg/GPSFix"), default=False
    ),
    Builtin("GridCellsAdapter", "grid_cells", "GridCells", ("nav_msgs/msg/GridCells",)),
    Builtin("HeaderAdapter", "header", "Header", ("std_msgs/msg/Header",)),
    Builtin("ImageAdapter", "image", "Image", ("sensor_msgs/msg/Image",)),
    Builtin("IMUAdapter", "imu", "IMU", ("sensor_msgs/msg/Imu",)),
    Builtin(
        "InertiaAdapter",
        "inertia",
        "Inertia",
        ("geometry_msgs/msg/Inertia", "geometry_msgs/msg/InertiaStamped"),
    ),
    Builtin(
        "Integer16StdAdapter",
        "integer16",
        "Integer16",
        ("std_msgs/msg/Int16", "example_interfaces/msg/Int16"),
    ),
    Builtin(
        "Integer32StdAdapter",
        "integer32",
        "Integer32",
        ("std_msgs/msg/Int32", "example_interfaces/msg/Int32"),
    ),
    Builtin(
        "Integer64StdAdapter",
        "integer64",
        "Integer64",
        ("std_msgs/msg/Int64", "example_interfaces/msg/Int64"),
    ),
    Builtin(
        "Integer8StdAdapter", "integer8", "Integer8", ("std_msgs/msg/Int8", "example_interfaces/msg/Int8")
    ),
    Builtin("JoyAdapter", "joy", "Joy", ("sensor_msgs/msg/Joy",)),
    Builtin("LaserScanAdapter", "laser_scan", "LaserScan", ("sensor_msgs/msg/LaserScan",)),
    Builtin("LidarAdapter", "lidar", "Lidar", ("sensor_msgs/msg/PointCloud2",), default=False),
    Builtin(
        "LivoxAdapter",
        "livox",
        "Lidar",
        ("livox_ros_driver2/msg/CustomMsg", "livox_ros_driver/msg/CustomMsg"),
        default=False,
    ),
    Builtin("MagneticFieldAdapter", "magnetic_field", "Magnetometer", ("sensor_msgs/msg/MagneticField",)),
    Builtin("MapMetadataAdapter", "map_metadata", "MapMetadata", ("nav_msgs/msg/MapMetaData",)),
    Builtin(
        "MultiEchoLaserScanAdapter",
        "multi_echo_laser_scan",
        "MultiEchoLaserScan",
        ("sensor_msgs/msg/MultiEchoLaserScan",),
    ),
    Builtin("NavSatStatusAdapter", "nav_sat_status", "GPSStatus", ("sensor_msgs/msg/NavSatStatus",)),
    Builtin("NMEASentenceAdapter", "nmea_sentence", "NMEASentence", ("nmea_msgs/msg/Sentence",)),
    Builtin("OccupancyGridAdapter", "occupancy_grid", "OccupancyGrid", ("nav_msgs/msg/OccupancyGrid",)),
    Builtin("OdometryAdapter", "odometry", "MotionState", ("nav_msgs/msg/Odometry",)),
    Builtin(
        "PointAdapter",
        "point",
        "Point3d",
        ("geometry_msgs/msg/Point", "geometry_msgs/msg/PointStamped", "geometry_msgs/msg/Point32"),
    ),
    Builtin("PointCloudAdapter", "point_cloud", "PointCloud2", ("sensor_msgs/msg/PointCloud2",)),
    Builtin(
        "PolygonAdapter",
        "polygon",
        "Polygon",
        ("geometry_msgs/msg/Polygon", "geometry_msgs/msg/PolygonStamped"),
    ),
    Builtin(
        "PoseAdapter",
        "pose",
        "Pose",
        (
            "geometry_msgs/msg/Pose",
            "geometry_msgs/msg/PoseStamped",
            "geometry_msgs/msg/PoseWithCovariance",
            "geometry_msgs/msg/PoseWithCovarianceStamped",
        ),
    ),
    Builtin("Pose2DAdapter", "pose_2d", "Pose", ("geometry_msgs/msg/Pose2D",)),
    Builtin("PoseArrayAdapter", "pose_array", "RobotPath", ("geometry_msgs/msg/PoseArray",), default=False),
    Builtin("PressureAdapter", "pressure", "Pressure", ("sensor_msgs/msg/FluidPressure",)),
    Builtin(
        "QuaternionAdapter",
        "quaternion",
        "Quaternion",
        ("geometry_msgs/msg/Quaternion", "geometry_msgs/msg/QuaternionStamped"),
    ),
    Builtin("RadarAdapter", "radar", "Radar", ("sensor_msgs/msg/PointCloud2",), default=False),
    Builtin("RangeAdapter", "range", "Range", ("sensor_msgs/msg/Range",)),
    Builtin(
        "RGBDCameraAdapter", "rgbd_camera", "RGBDCamera", ("sensor_msgs/msg/PointCloud2",), default=False
    ),
    Builtin("RobotJointAdapter", "robot_joint", "RobotJoint", ("sensor_msgs/msg/JointState",)),
    Builtin("RobotPathAdapter", "robot_path", "RobotPath", ("nav_msgs/msg/Path",)),
    Builtin("ROIAdapter", "roi", "ROI", ("sensor_msgs/msg/RegionOfInterest",)),
    Builtin(
        "StereoCameraAdapter",
        "stereo_camera",
        "StereoCamera",
        ("sensor_msgs/msg/PointCloud2",),
        default=False,
    ),
    Builtin("StringStdAdapter", "string", "String", ("std_msgs/msg/String", "example_interfaces/msg/String")),
    Builtin("TemperatureAdapter", "temperature", "Temperature", ("sensor_msgs/msg/Temperature",)),
    Builtin(
        "TimeAdapter",
        "time",
        "Time",
        ("builtin_interfaces/msg/Time", "std_msgs/msg/Time", "rosgraph_msgs/msg/Clock"),
    ),
    Builtin("ToFCameraAdapter", "tof_camera", "ToFCamera", ("sensor_msgs/msg/PointCloud2",), default=False),
    Builtin(
        "TransformAdapter",
        "transform",
        "Transform",
        ("geometry_msgs/msg/Transform", "geometry_msgs/msg/TransformStamped"),
    ),
    Builtin(
        "TwistAdapter",
        "twist",
        "Velocity",
        (
            "geometry_msgs/msg/Twist",
            "geometry_msgs/msg/TwistStamped",
            "geometry_msgs/msg/TwistWithCovariance",
            "geometry_msgs/msg/TwistWithCovarianceStamped",
        ),
    ),
    Builtin(
        "Unsigned16StdAdapter",
        "unsigned16",
        "Unsigned16",
        ("std_msgs/msg/UInt16", "example_interfaces/msg/UInt16"),
    ),
    Builtin(
        "Unsigned32StdAdapter",
        "unsigned32",
        "Unsigned32",
        ("std_msgs/msg/UInt32", "example_interfaces/msg/UInt32"),
    ),
    Builtin(
        "Unsigned64StdAdapter",
        "unsigned64",
        "Unsigned64",
        ("std_msgs/msg/UInt64", "example_interfaces/msg/UInt64"),
    ),
    Builtin(
        "Unsigned8StdAdapter",
        "unsigned8",
        "Unsigned8",
        (
            "std_msgs/msg/UInt8",
            "example_interfaces/msg/UInt8",
            "std_msgs/msg/Byte",
            "example_interfaces/msg/Byte",
            "std_msgs/msg/Char",
            "example_interfaces/msg/Char",
        ),
    ),
    Builtin(
        "Vector3Adapter",
        "vector3",
        "Vector3d",
        ("geometry_msgs/msg/Vector3", "geometry_msgs/msg/Vector3Stamped"),
    ),
    Builtin(
        "WrenchAdapter",
        "wrench",
        "ForceTorque",
        ("geometry_msgs/msg/Wrench", "geometry_msgs/msg/WrenchStamped"),
    ),
)


BY_NAME: dict[str, Builtin] = {builtin.name: builtin for builtin in BUILTIN}
BY_TYPE: dict[str, Builtin] = {
    msgtype: builtin for builtin in BUILTIN if builtin.default for msgtype in builtin.ros_types
}
