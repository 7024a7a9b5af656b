"""Images, camera calibration and regions of interest."""

from __future__ import annotations

from enum import Enum
from typing import Annotated

from mosaico_ingest.ontology.geometry import Vector2d
from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.model import FixedSize, Float64, Int32, Serializable, UInt32
from mosaico_ingest.ontology.types import SerializationFormat


class ImageFormat(str, Enum):
    """The encoding of an image's bytes."""

    RAW = "raw"
    PNG = "png"
    JPEG = "jpeg"
    JPG = "jpg"
    TIFF = "tiff"
    H264 = "h264"
    HEVC = "hevc"


class Image(Stamped, Serializable):
    """An image with a known pixel format."""

    __serialization_format__ = SerializationFormat.IMAGE

    data: bytes
    """The image rows of `stride` bytes each, encoded as `format`."""
    format: ImageFormat
    """The encoding of `data`; `png` is a lossless grayscale picture `stride` bytes wide, whatever the pixel encoding."""
    width: Int32
    """Width in pixels."""
    height: Int32
    """Height in pixels."""
    stride: Int32
    """Bytes per image row."""
    encoding: str
    """The pixel encoding, such as `rgb8`."""
    is_bigendian: bool | None = None
    """Byte order of multi-byte pixels."""


class CompressedImage(Stamped, Serializable):
    """A compressed image, or a part of a video stream, as the camera sent it."""

    __serialization_format__ = SerializationFormat.IMAGE

    data: bytes
    """The compressed bytes, unchanged."""
    format: ImageFormat
    """The encoding of `data`."""


class ROI(Serializable):
    """A rectangle within an image."""

    offset: Vector2d
    """Upper left corner in pixels."""
    height: UInt32
    """Height in pixels."""
    width: UInt32
    """Width in pixels."""
    do_rectify: bool | None = None
    """Whether the rectangle also applies to the rectified image."""


class CameraInfo(Stamped, Serializable):
    """The calibration of a camera; matrices are in row-major order."""

    height: UInt32
    """Height in pixels at calibration."""
    width: UInt32
    """Width in pixels at calibration."""
    distortion_model: str
    """The distortion model, such as `plumb_bob`."""
    distortion_parameters: list[Float64]
    """The parameters of the distortion model."""
    intrinsic_parameters: Annotated[list[Float64], FixedSize(9)]
    """3 x 3, pixels: focal lengths and principal point of the raw image."""
    rectification_parameters: Annotated[list[Float64], FixedSize(9)]
    """3 x 3: the rotation that aligns the rows of a stereo pair."""
    projection_parameters: Annotated[list[Float64], FixedSize(12)]
    """3 x 4, pixels: projection of the rectified image."""
    binning: Vector2d | None = None
    """Number of sensor pixels combined into one, horizontally and vertically; null without binning."""
    roi: ROI | None = None
    """The part of the sensor in use; null for the complete sensor."""
