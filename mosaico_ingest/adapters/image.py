"""Lossless PNG storage of raw images: the buffer's bytes as an 8-bit grayscale picture."""

from __future__ import annotations

import struct
import zlib
from io import BytesIO
from typing import Any

import numpy as np
import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.adapters.adapter import Adapted, Adapter, AdapterSpec, Envelope
from mosaico_ingest.errors import AdapterError, missing_library
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.rosbag.definitions.model import Definition

IMAGE_TAG = "Image"
"""The tag of the ontology type whose rows can be stored as PNG."""
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GRAYSCALE_8_BIT = bytes((8, 0, 0, 0, 0))
_FASTEST = 1


def grayscale_png(data: bytes | memoryview, *, width: int, height: int) -> bytes:
    """Return `data`, which contains `height` rows of `width` bytes, as a PNG; both are positive."""
    scanlines = np.empty((height, width + 1), np.uint8)
    scanlines[:, 0] = 0  # the filter type "none"
    scanlines[:, 1:] = np.frombuffer(data, np.uint8).reshape(height, width)
    header = struct.pack(">II", width, height) + _GRAYSCALE_8_BIT
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(scanlines.data, _FASTEST)), (b"IEND", b""))
    return _SIGNATURE + b"".join(_chunk(kind, body) for kind, body in chunks)


def grayscale_pixels(png: bytes) -> bytes:
    """Return the bytes of an 8-bit grayscale PNG. Pillow reads PNGs with filtered lines, as the official SDK writes.

    Raises:
        AdapterError: The picture is not an 8-bit grayscale PNG.
        IngestError: Pillow is not installed.
    """
    offset, compressed = len(_SIGNATURE), b""
    width = height = 0
    try:
        while offset < len(png):
            (size,) = struct.unpack_from(">I", png, offset)
            kind, body = png[offset + 4 : offset + 8], png[offset + 8 : offset + 8 + size]
            offset += size + 12
            if kind == b"IHDR":
                width, height = struct.unpack(">II", body[:8])
                if body[8:] != _GRAYSCALE_8_BIT:
                    raise AdapterError("the picture is not an 8-bit grayscale PNG")
            compressed += body if kind == b"IDAT" else b""
        scanlines = np.frombuffer(zlib.decompress(compressed), np.uint8).reshape(height, width + 1)
    except (struct.error, zlib.error, ValueError) as error:
        raise AdapterError(f"the picture is not a PNG: {error}") from error
    return _unfiltered(png) if scanlines[:, 0].any() else scanlines[:, 1:].tobytes()


def _unfiltered(png: bytes) -> bytes:
    try:
        from PIL import Image  # noqa: PLC0415 - an optional library
    except ImportError as error:
        raise missing_library("Pillow", "images") from error
    with Image.open(BytesIO(png), formats=["PNG"]) as picture:
        return picture.tobytes()


def without_png(rows: pa.StructArray) -> pa.StructArray:
    """Return images with their raw buffers; images that are stored as PNG are decoded."""
    columns = {field.name: rows.field(field.name) for field in rows.type}
    formats = columns["format"].to_pylist()
    if "png" not in formats:
        return rows
    data: list[bytes | memoryview] = [
        grayscale_pixels(raw.as_py()) if formats[row] == "png" else memoryview(raw.as_buffer())
        for row, raw in enumerate(columns["data"])
    ]
    columns["data"] = pa.array(data, rows.type.field("data").type)
    columns["format"] = pa.array(["raw" if name == "png" else name for name in formats], pa.string())
    return pa.StructArray.from_arrays(list(columns.values()), fields=list(rows.type))


def _chunk(kind: bytes, body: bytes) -> bytes:
    checksum = zlib.crc32(body, zlib.crc32(kind))
    return b"".join((struct.pack(">I", len(body)), kind, body, struct.pack(">I", checksum)))


class PngImageSpec(Struct, frozen=True):
    """Stores the raw images of an adapter as PNG; adapters of other ontology types are unchanged."""

    inner: AdapterSpec

    @property
    def name(self) -> str:
        """The inner adapter's name."""
        return self.inner.name

    @property
    def ros_types(self) -> tuple[str, ...]:
        """The inner adapter's types."""
        return self.inner.ros_types

    @property
    def default(self) -> bool:
        """Whether the inner adapter is the default of its types."""
        return self.inner.default

    def bind(self, definition: Definition, shape: pa.StructType) -> Adapter:
        """Bind the inner adapter."""
        adapter = self.inner.bind(definition, shape)
        return _PngImages(adapter) if adapter.ontology.tag == IMAGE_TAG else adapter


class _PngImages(Struct, frozen=True):
    inner: Adapter

    @property
    def ontology(self) -> OntologyType:
        return self.inner.ontology

    def topic_metadata(self, first_row: pa.StructScalar | None) -> dict[str, Any]:
        return self.inner.topic_metadata(first_row)

    def adapt(self, rows: pa.StructArray, envelope: Envelope) -> Adapted:
        adapted = self.inner.adapt(rows, envelope)
        return Adapted(_as_png(adapted.rows), adapted.index, adapted.failures)


def _as_png(rows: pa.StructArray) -> pa.StructArray:
    """Encode each image whose buffer has height x stride bytes as PNG; other images stay raw."""
    columns = {field.name: rows.field(field.name) for field in rows.type}
    heights, strides = columns["height"].to_numpy(), columns["stride"].to_numpy()
    formats = columns["format"].to_pylist()
    data: list[bytes | memoryview] = []
    for row, raw in enumerate(columns["data"]):
        buffer, height, width = raw.as_buffer(), int(heights[row]), int(strides[row])
        if formats[row] == "raw" and height > 0 and width > 0 and buffer.size == height * width:
            data.append(grayscale_png(memoryview(buffer), width=width, height=height))
            formats[row] = "png"
        else:
            data.append(memoryview(buffer))
    columns["data"] = pa.array(data, rows.type.field("data").type)
    columns["format"] = pa.array(formats, rows.type.field("format").type)
    return pa.StructArray.from_arrays(list(columns.values()), fields=list(rows.type))
