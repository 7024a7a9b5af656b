"""This file is the built-in tags: which module defines which, so that a look-up imports one and not all."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["DEFINED", "MODULES"]

DEFINED: dict[str, type[Serializable]] = {}
"""Every model class by tag, from the moment it is defined; a later one of the same tag replaces it."""

MODULES: Mapping[str, str] = MappingProxyType(
    {
        tag: module
        for module, names in {
            "battery": "BatteryState",
            "camera": "CameraInfo",
            "depth_camera": "RGBDCamera StereoCamera ToFCamera",
            "dynamics": "ForceTorque Inertia",
            "geometry": "Point2d Point3d Polygon Pose Quaternion RobotPath Transform Vector2d Vector3d Vector4d",
            "gps": "GPS GPSStatus NMEASentence",
            "grids": "GridCells MapMetadata OccupancyGrid",
            "header": "Duration Header Time",
            "image": "CompressedImage Image",
            "imu": "IMU",
            "joy": "Joy",
            "kinematics": "Acceleration MotionState Velocity",
            "laser": "LaserScan MultiEchoLaserScan",
            "lidar": "Lidar",
            "magnetometer": "Magnetometer",
            "point_cloud": "PointCloud2 PointField",
            "pressure": "Pressure",
            "radar": "Radar",
            "range": "Range",
            "robot": "RobotJoint",
            "roi": "ROI",
            "scalars": (
                "Boolean Floating16 Floating32 Floating64 Integer16 Integer32 Integer64 Integer8 "
                "String Unsigned16 Unsigned32 Unsigned64 Unsigned8"
            ),
            "temperature": "Temperature",
            "transforms": "FrameTransform",
            "unmodeled": "Unmodeled",
        }.items()
        for tag in names.split()
    }
)
"""The built-in tags, which are class names, and the module each is defined in."""
