"""The models of sensors, as in `mosaicolabs.models.sensors`."""

from mosaico_ingest.ontology import (
    GPS,
    IMU,
    CameraInfo,
    CompressedImage,
    GPSStatus,
    Image,
    ImageFormat,
    Joy,
    Magnetometer,
    NMEASentence,
    Pressure,
    Range,
    RobotJoint,
    Temperature,
)

__all__ = [
    "GPS",
    "IMU",
    "CameraInfo",
    "CompressedImage",
    "GPSStatus",
    "Image",
    "ImageFormat",
    "Joy",
    "Magnetometer",
    "NMEASentence",
    "Pressure",
    "Range",
    "RobotJoint",
    "Temperature",
]
