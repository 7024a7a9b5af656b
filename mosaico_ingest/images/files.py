"""Image files: their types and samples, the writers of PNG and JPEG, and the conversion of raw images to them."""

from __future__ import annotations

import io
import struct
import zlib
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from mosaico_ingest.errors import ViewError, missing_library
from mosaico_ingest.images import RawImage, Samples, eight_bits, has_colors, raw_samples
from mosaico_ingest.job.fields import ImageSettings

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

EXTRA = "images"
"""The extra of this package that installs Pillow."""
_SIGNATURES = {
    b"\x89PNG": "png",
    b"\xff\xd8\xff": "jpeg",
    b"RIFF": "webp",
    b"II*\0": "tiff",
    b"MM\0*": "tiff",
    b"BM": "bmp",
}
_PNG_LEVEL, _PNG_RUN_LENGTHS = 1, 3
"""The fastest level of zlib, and its strategy that searches only for repetitions of one byte: after PNG's filters, this takes
three quarters of the default's time and makes photos 12 % smaller."""
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


def image_file_type(data: bytes | memoryview) -> str | None:
    """Return the type of an image file, such as `png`, or None if the bytes are not an image file."""
    start = bytes(data[:4])
    return next((name for signature, name in _SIGNATURES.items() if start.startswith(signature)), None)


def file_samples(data: bytes, *, keep_alpha: bool = False) -> npt.NDArray[Any]:
    """Return the samples of an image file: 8-bit RGB, or one channel with the depth of the file.

    With `keep_alpha`, a file with transparency has RGBA samples.

    Raises:
        ViewError: The bytes are not an image file, or the file is damaged.
        IngestError: Pillow is not installed.
    """
    picture = _opened(data)
    try:
        if picture.mode in {"L", "F", "I"} or picture.mode.startswith("I;16"):
            samples = np.asarray(picture)
            # Some versions of Pillow open PNG files of 16 bits in the mode "I".
            is_16_bit = picture.mode != "I" or picture.format == "PNG"
            return samples.astype(np.uint16) if picture.mode.startswith("I") and is_16_bit else samples
        has_alpha = keep_alpha and picture.mode == "RGBA"
        return np.asarray(picture if has_alpha else picture.convert("RGB"))
    except (OSError, ValueError, SyntaxError) as error:
        raise ViewError(f"the image file is damaged: {error}") from error


def png_file(samples: npt.NDArray[Any]) -> bytes:
    """Return 8-bit gray, RGB or RGBA samples, or 16-bit gray samples, as a PNG file.

    Raises:
        IngestError: Pillow is not installed.
    """
    buffer = io.BytesIO()
    picture_of(samples).save(buffer, "PNG", compress_level=_PNG_LEVEL, compress_type=_PNG_RUN_LENGTHS)
    return buffer.getvalue()


def jpeg_file(samples: npt.NDArray[np.uint8], *, quality: int) -> bytes:
    """Return gray or RGB samples as a JPEG file; `quality` is 1 to 100.

    Raises:
        IngestError: Pillow is not installed.
    """
    buffer = io.BytesIO()
    picture_of(samples).save(buffer, "JPEG", quality=quality)
    return buffer.getvalue()


def resized(samples: npt.NDArray[Any], *, width: int, height: int) -> npt.NDArray[Any]:
    """Return a picture in another size; each new pixel is a weighted mean of the pixels that it covers.

    Raises:
        IngestError: Pillow is not installed.
    """
    return np.asarray(picture_of(samples).resize((width, height), pillow("Image").Resampling.BILINEAR))


def require_pillow() -> None:
    """Raise IngestError, with the extra that installs it, if Pillow is not installed."""
    pillow("Image")


def pillow(module: str) -> Any:  # noqa: ANN401 - a module
    """Return a module of Pillow, which only images need.

    Raises:
        IngestError: Pillow is not installed.
    """
    try:
        return import_module(f"PIL.{module}")
    except ImportError as error:
        raise missing_library("Pillow", EXTRA) from error


def picture_of(samples: npt.NDArray[Any]) -> Picture:
    """Return samples as a picture of Pillow.

    Raises:
        IngestError: Pillow is not installed.
    """
    return pillow("Image").fromarray(samples)


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


def _opened(data: bytes) -> Picture:
    image = pillow("Image")
    try:
        return image.open(io.BytesIO(data))
    except (OSError, ValueError, SyntaxError, image.DecompressionBombError) as error:
        start = data[:8].hex(" ")
        raise ViewError(f"Pillow cannot read the bytes as an image file; they start with {start}") from error


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
