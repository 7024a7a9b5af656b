"""Images, camera calibration and regions of interest."""

from __future__ import annotations

from enum import Enum
from typing import Annotated

from mosaico_ingest.ontology.geometry import Vector2d
from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.model import FixedSize, Float64, Int32, Serializable, UInt32
from mosaico_ingest.ontology.types import SerializationFormat

__all__ = [
    "ROI",
    "CameraInfo",
    "CompressedImage",
    "Image",
    "ImageFormat",
]


class ImageFormat(str, Enum):
    """How the bytes of a picture are packed."""

    RAW = "raw"
    PNG = "png"
    JPEG = "jpeg"
    JPG = "jpg"
    TIFF = "tiff"
    H264 = "h264"
    HEVC = "hevc"


class Image(Stamped, Serializable):
    """A picture whose pixels are known."""

    __serialization_format__ = SerializationFormat.IMAGE

    data: bytes
    """The rows of pixels, `stride` bytes each, packed as `format` says."""
    format: ImageFormat
    """`png` is lossless: a grey picture `stride` bytes wide, whatever the encoding."""
    width: Int32
    """pixels."""
    height: Int32
    """pixels."""
    stride: Int32
    """bytes from one row to the next."""
    encoding: str
    """What a pixel is, as `rgb8`."""
    is_bigendian: bool | None = None
    """Byte order of pixels wider than a byte."""


class CompressedImage(Stamped, Serializable):
    """A picture, or a piece of a video stream, as the camera compressed it."""

    __serialization_format__ = SerializationFormat.IMAGE

    data: bytes
    """The compressed bytes, unchanged."""
    format: ImageFormat
    """What they are."""


class ROI(Serializable):
    """A rectangle of pixels."""

    offset: Vector2d
    """Its left upper corner, pixels."""
    height: UInt32
    """pixels."""
    width: UInt32
    """pixels."""
    do_rectify: bool | None = None
    """Whether a rectified picture should be cut there too."""


class CameraInfo(Stamped, Serializable):
    """How a camera maps space to pixels; matrices are row by row."""

    height: UInt32
    """pixels, at calibration."""
    width: UInt32
    """pixels, at calibration."""
    distortion_model: str
    """As `plumb_bob`."""
    distortion_parameters: list[Float64]
    """As many as the model has."""
    intrinsic_parameters: Annotated[list[Float64], FixedSize(9)]
    """3 by 3, pixels: focal lengths and principal point of the raw picture."""
    rectification_parameters: Annotated[list[Float64], FixedSize(9)]
    """3 by 3: the rotation that makes a stereo pair's rows parallel."""
    projection_parameters: Annotated[list[Float64], FixedSize(12)]
    """3 by 4, pixels: of the rectified picture."""
    binning: Vector2d | None = None
    """Sensor pixels joined to one, across and down; null: none."""
    roi: ROI | None = None
    """The part of the sensor in use; null: all."""
