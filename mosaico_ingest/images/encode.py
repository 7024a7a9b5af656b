"""Raw images as PNG and JPEG pictures: the formats that fit each encoding, and the conversion of the samples."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from mosaico_ingest.errors import ViewError
from mosaico_ingest.images.encodings import RawImage, Samples, eight_bits, has_colors, raw_samples
from mosaico_ingest.images.files import file_samples, jpeg_file, png_file, resized
from mosaico_ingest.job.fields import ImageSettings

_RGB = 3
_MAX_DEPTH = 0xFFFF
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GRAY_8_BIT = bytes((8, 0, 0, 0, 0))
_FASTEST = 1


class EncodedImage(Struct, frozen=True):
    """An image file, and the layout of the raw image to which it decodes."""

    data: bytes
    encoding: str
    width: int
    height: int
    stride: int
    """Bytes per row of the decoded image."""
    is_bigendian: bool = False


def encode_image(image: RawImage, settings: ImageSettings) -> EncodedImage | None:
    """Return a raw image as an image file, not wider than `settings.max_width`.

    The result is None for `buffer_png` if the buffer has another size than its rows.

    Raises:
        ViewError: The encoding is unknown or does not fit the format, or the buffer is too short.
        IngestError: Pillow is not installed.
    """
    if settings.format == "buffer_png":
        return _buffer_png(image)
    samples = raw_samples(image)
    if settings.format == "jpeg":
        values = _jpeg_samples(samples, image.encoding)
    else:
        values = _png_samples(samples, image.encoding, settings.depth_unit)
    values = _narrowed(values, settings.max_width, is_measured=samples.is_measured)
    height, width = values.shape[:2]
    try:
        data = jpeg_file(values, quality=settings.quality) if settings.format == "jpeg" else png_file(values)
    except (OSError, ValueError, SystemError) as error:  # Pillow's, for sizes that a format does not have
        raise ViewError(f"{settings.format} cannot store {width} x {height} pixels: {error}") from error
    encoding = _encoding_of(values, is_measured=samples.is_measured)
    return EncodedImage(data, encoding, width, height, values.nbytes // height)


def decoded_buffer(data: bytes) -> bytes:
    """Return the raw buffer of an image file, without padding; 16-bit samples are little-endian.

    Raises:
        ViewError: The bytes are not an image file, or the file is damaged.
        IngestError: Pillow is not installed.
    """
    samples = file_samples(data, keep_alpha=True)
    return samples.astype(samples.dtype.newbyteorder("<")).tobytes()


def _buffer_png(image: RawImage) -> EncodedImage | None:
    """Return the bytes of an image as a gray PNG, which is as wide as a row has bytes."""
    width, height = image.stride, image.height
    if width <= 0 or height <= 0 or len(image.data) != width * height:
        return None
    scanlines = np.empty((height, width + 1), np.uint8)
    scanlines[:, 0] = 0  # the filter type "none"
    scanlines[:, 1:] = np.frombuffer(image.data, np.uint8).reshape(height, width)
    header = struct.pack(">II", width, height) + _GRAY_8_BIT
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(scanlines.data, _FASTEST)), (b"IEND", b""))
    data = _PNG_SIGNATURE + b"".join(_chunk(kind, body) for kind, body in chunks)
    return EncodedImage(data, image.encoding, image.width, height, width, image.is_bigendian)


def _chunk(kind: bytes, body: bytes) -> bytes:
    checksum = zlib.crc32(body, zlib.crc32(kind))
    return b"".join((struct.pack(">I", len(body)), kind, body, struct.pack(">I", checksum)))


def _jpeg_samples(samples: Samples, encoding: str) -> npt.NDArray[np.uint8]:
    if samples.is_measured:
        raise ViewError(
            f"{encoding} contains measurements, which JPEG would change; png, buffer_png and raw keep them"
        )
    if samples.values.dtype.kind != "u":
        raise ViewError(f"{encoding} is not an encoding of pictures; raw and buffer_png keep it")
    pixels = eight_bits(samples.values)
    return np.ascontiguousarray(pixels[..., :_RGB]) if has_colors(pixels) else pixels


def _png_samples(samples: Samples, encoding: str, depth_unit: float) -> npt.NDArray[Any]:
    values = samples.values
    if samples.is_measured and not has_colors(values) and values.dtype.kind == "f":
        return _quantized(values, depth_unit)
    fits = values.dtype == np.uint8 or (values.dtype == np.uint16 and not has_colors(values))
    if not fits or (samples.is_measured and has_colors(values)):
        raise ViewError(f"png cannot store samples of {encoding}; raw and buffer_png keep them")
    return values


def _quantized(depth: npt.NDArray[np.floating[Any]], unit: float) -> npt.NDArray[np.uint16]:
    """Return depth in m as multiples of a unit; without a measurement (NaN, infinity), 0 as in the 16-bit images of ROS."""
    finite = np.isfinite(depth)
    steps = np.rint(np.where(finite, depth, 0).astype(np.float64) / unit)
    low, high = float(steps.min()), float(steps.max())
    if low < 0 or high > _MAX_DEPTH:
        value = (low if low < 0 else high) * unit
        raise ViewError(
            f"a depth of {value:g} m is outside 0 to {_MAX_DEPTH * unit:g} m, the range of 16 bits in steps of {unit:g} m"
        )
    return steps.astype(np.uint16)


def _narrowed(values: npt.NDArray[Any], max_width: int | None, *, is_measured: bool) -> npt.NDArray[Any]:
    """Return the samples scaled to a maximum width; measurements are picked, because their means do not exist."""
    height, width = values.shape[:2]
    if max_width is None or width <= max_width:
        return values
    new_height = max(1, round(height * max_width / width))
    if is_measured:
        return np.ascontiguousarray(values[np.ix_(_picked(height, new_height), _picked(width, max_width))])
    return resized(values, width=max_width, height=new_height)


def _picked(old: int, new: int) -> npt.NDArray[np.int64]:
    """Return the positions of `new` samples at equal distances among `old` ones."""
    return ((np.arange(new) + 0.5) * old / new).astype(np.int64)


def _encoding_of(values: npt.NDArray[Any], *, is_measured: bool) -> str:
    bits = values.dtype.itemsize * 8
    if has_colors(values):
        return f"{'rgb' if values.shape[2] == _RGB else 'rgba'}{bits}"
    return f"{bits}UC1" if is_measured else f"mono{bits}"
