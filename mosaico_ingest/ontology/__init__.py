"""Typed models and their exact Arrow columns; knows nothing of ROS.

`from mosaico_ingest.ontology import IMU` imports that model and what it is made of; nothing is imported before.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from mosaico_ingest.ontology.tags import MODULES

if TYPE_CHECKING:
    from mosaico_ingest.ontology.battery import BatteryState
    from mosaico_ingest.ontology.camera import CameraInfo
    from mosaico_ingest.ontology.depth_camera import RGBDCamera, StereoCamera, ToFCamera
    from mosaico_ingest.ontology.dynamics import ForceTorque, Inertia
    from mosaico_ingest.ontology.geometry import (
        Point2d,
        Point3d,
        Polygon,
        Pose,
        Quaternion,
        RobotPath,
        Transform,
        Vector2d,
        Vector3d,
        Vector4d,
    )
    from mosaico_ingest.ontology.gps import GPS, GPSStatus, NMEASentence
    from mosaico_ingest.ontology.grids import GridCells, MapMetadata, OccupancyGrid
    from mosaico_ingest.ontology.header import Duration, Header, Time
    from mosaico_ingest.ontology.image import CompressedImage, Image, ImageFormat
    from mosaico_ingest.ontology.imu import IMU
    from mosaico_ingest.ontology.joy import Joy
    from mosaico_ingest.ontology.kinematics import Acceleration, MotionState, Velocity
    from mosaico_ingest.ontology.laser import LaserScan, MultiEchoLaserScan
    from mosaico_ingest.ontology.lidar import Lidar
    from mosaico_ingest.ontology.magnetometer import Magnetometer
    from mosaico_ingest.ontology.message import Message
    from mosaico_ingest.ontology.point_cloud import PointCloud2, PointField, PointFieldDataType
    from mosaico_ingest.ontology.pressure import Pressure
    from mosaico_ingest.ontology.radar import Radar
    from mosaico_ingest.ontology.range import Range
    from mosaico_ingest.ontology.robot import RobotJoint
    from mosaico_ingest.ontology.roi import ROI
    from mosaico_ingest.ontology.scalars import (
        Boolean,
        Floating16,
        Floating32,
        Floating64,
        Integer8,
        Integer16,
        Integer32,
        Integer64,
        String,
        Unsigned8,
        Unsigned16,
        Unsigned32,
        Unsigned64,
    )
    from mosaico_ingest.ontology.serializable import Serializable
    from mosaico_ingest.ontology.temperature import Temperature
    from mosaico_ingest.ontology.transforms import FrameTransform
    from mosaico_ingest.ontology.types import OntologyType, SerializationFormat
    from mosaico_ingest.ontology.unmodeled import Unmodeled

__all__ = [
    "GPS",
    "IMU",
    "ROI",
    "Acceleration",
    "BatteryState",
    "Boolean",
    "CameraInfo",
    "CompressedImage",
    "Duration",
    "Floating16",
    "Floating32",
    "Floating64",
    "ForceTorque",
    "FrameTransform",
    "GPSStatus",
    "GridCells",
    "Header",
    "Image",
    "ImageFormat",
    "Inertia",
    "Integer8",
    "Integer16",
    "Integer32",
    "Integer64",
    "Joy",
    "LaserScan",
    "Lidar",
    "Magnetometer",
    "MapMetadata",
    "Message",
    "MotionState",
    "MultiEchoLaserScan",
    "NMEASentence",
    "OccupancyGrid",
    "OntologyType",
    "Point2d",
    "Point3d",
    "PointCloud2",
    "PointField",
    "PointFieldDataType",
    "Polygon",
    "Pose",
    "Pressure",
    "Quaternion",
    "RGBDCamera",
    "Radar",
    "Range",
    "RobotJoint",
    "RobotPath",
    "Serializable",
    "SerializationFormat",
    "StereoCamera",
    "String",
    "Temperature",
    "Time",
    "ToFCamera",
    "Transform",
    "Unmodeled",
    "Unsigned8",
    "Unsigned16",
    "Unsigned32",
    "Unsigned64",
    "Vector2d",
    "Vector3d",
    "Vector4d",
    "Velocity",
]

_OTHERS = {
    "ImageFormat": "image",
    "Message": "message",
    "OntologyType": "types",
    "PointFieldDataType": "point_cloud",
    "Serializable": "serializable",
    "SerializationFormat": "types",
}


def __getattr__(name: str) -> Any:  # noqa: ANN401 - any of the names
    """Import the module that defines `name`."""
    module = MODULES.get(name) or _OTHERS.get(name)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{module}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
