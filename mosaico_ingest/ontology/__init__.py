"""The ontology: typed models and their exact Arrow schemas, grouped by domain.

The package receives field values and returns validated models or Arrow columns. It must not depend on ROS or on storage.
`from mosaico_ingest.ontology import IMU` imports only that model and the models it is composed of.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from mosaico_ingest.ontology.registry import MODULES

if TYPE_CHECKING:
    from mosaico_ingest.ontology.geometry import (
        Acceleration,
        ForceTorque,
        FrameTransform,
        Inertia,
        MotionState,
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
        Velocity,
    )
    from mosaico_ingest.ontology.model import Duration, Header, Message, Serializable, Time
    from mosaico_ingest.ontology.perception import (
        ROI,
        CameraInfo,
        CompressedImage,
        GridCells,
        Image,
        ImageFormat,
        LaserScan,
        Lidar,
        MapMetadata,
        MultiEchoLaserScan,
        OccupancyGrid,
        PointCloud2,
        PointField,
        PointFieldDataType,
        Radar,
        Range,
        RGBDCamera,
        StereoCamera,
        ToFCamera,
    )
    from mosaico_ingest.ontology.registry import OntologyType, SerializationFormat
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
        Unmodeled,
        Unsigned8,
        Unsigned16,
        Unsigned32,
        Unsigned64,
    )
    from mosaico_ingest.ontology.sensors import (
        GPS,
        IMU,
        BatteryState,
        GPSStatus,
        Joy,
        Magnetometer,
        NMEASentence,
        Pressure,
        RobotJoint,
        Temperature,
    )

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
    "ImageFormat": "perception",
    "Message": "model",
    "OntologyType": "registry",
    "PointFieldDataType": "perception",
    "Serializable": "model",
    "SerializationFormat": "registry",
}
"""The module of each name that is not a tag."""


def __getattr__(name: str) -> Any:  # noqa: ANN401 - any of the names
    """Import the module that defines `name`."""
    module = MODULES.get(name) or _OTHERS.get(name)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{module}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
