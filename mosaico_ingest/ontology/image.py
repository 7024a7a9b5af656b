"""This file is pictures, and how their bytes are packed."""

from __future__ import annotations

from enum import Enum

from mosaico_ingest.ontology.fields import Int32
from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.serializable import Serializable
from mosaico_ingest.ontology.types import SerializationFormat

__all__ = ["CompressedImage", "Image", "ImageFormat"]


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
