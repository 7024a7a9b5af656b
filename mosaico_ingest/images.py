"""Pictures: raw pixel encodings and image files, shared by ingestion (`image` settings), views and export.

Input: the buffer of an image and its layout, or an image file. Output: arrays of samples, or image files. The module depends
on no other stage; it imports Pillow when an image file is read or written.
"""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from mosaico_ingest.errors import ViewError, missing_library
from mosaico_ingest.job.fields import ImageSettings

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

_TURBO = np.array(
    [
        *((48, 18, 59), (70, 98, 216), (53, 171, 248), (27, 229, 181), (116, 254, 93)),
        *((201, 239, 52), (251, 185, 56), (245, 105, 24), (201, 41, 3), (122, 4, 3)),
    ],
    np.float32,
)
"""Colors at equal distances of the color map "Turbo": blue is near, red is far."""
_PERCENTILES = (1.0, 99.0)
_PNG = b"\x89PNG"
_HEADER = struct.Struct("<iff")
"""Compression format and the two quantization parameters that precede the payload."""
_SIZES = struct.Struct("<II")
_LARGEST = 1 << 28
"""Pixels above which the sizes in a payload are not credible."""
Pixels: TypeAlias = npt.NDArray[np.uint8]
"""An RGB picture, of shape (height, width, 3)."""
_Array: TypeAlias = npt.NDArray[Any]
_OPENCV = re.compile(r"(8U|8S|16U|16S|32S|32F|64F)C(\d*)")
_OPENCV_TYPES = {"8U": "u1", "8S": "i1", "16U": "u2", "16S": "i2", "32S": "i4", "32F": "f4", "64F": "f8"}
_BAYER = re.compile(r"bayer_(rggb|bggr|gbrg|grbg)(8|16)")
_COLORS = {
    f"{order}{bits}": (order, f"u{bits // 8}") for order in ("rgb", "bgr", "rgba", "bgra") for bits in (8, 16)
}
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
_RGB = 3
_FASTEST = 1


_OPENCV_ORDER = "bgra"
_EIGHT_BITS = 8
_COLOR_AXES = 3
"""Height, width and channels."""


class RawImage(Struct, frozen=True):
    """The buffer of an image and its layout."""

    data: bytes | memoryview
    width: int
    height: int
    stride: int
    """Bytes per row; 0 if the rows have no padding."""
    encoding: str
    is_bigendian: bool = False


class Samples(Struct, frozen=True):
    """The samples of a raw image: a picture, or measurements such as depth."""

    values: _Array
    """Gray values or measurements of shape (height, width), or colors of shape (height, width, n): RGB, RGBA, or two
    measurements per pixel."""
    is_measured: bool = False


class EncodedImage(Struct, frozen=True):
    """An image file, and the layout of the raw image to which it decodes."""

    data: bytes
    encoding: str
    width: int
    height: int
    stride: int
    """Bytes per row of the decoded image."""
    is_bigendian: bool = False


def color_map(values: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """Return measurements of shape (height, width) as RGB; zeros, NaN and infinities are black.

    The colors span the range from the 1st to the 99th percentile, so that outliers do not hide the rest.
    If all measurements are equal, they have the color in the middle.
    """
    mask = np.isfinite(values) & (values != 0)
    pixels = np.zeros((*values.shape, 3), np.uint8)
    if not mask.any():
        return pixels
    depths = values[mask].astype(np.float64)
    low, high = (float(bound) for bound in np.percentile(depths, _PERCENTILES))
    share = np.clip((depths - low) / (high - low), 0, 1) if high > low else np.full(depths.shape, 0.5)
    share *= len(_TURBO) - 1
    steps = np.arange(len(_TURBO))
    for channel in range(3):
        pixels[..., channel][mask] = np.rint(np.interp(share, steps, _TURBO[:, channel]))
    return pixels


def depth_payload(data: bytes) -> bytes | None:
    """Return the PNG inside a compressed depth image, or None if it has none."""
    if not data.startswith(_PNG) and data[_HEADER.size : _HEADER.size + len(_PNG)] == _PNG:
        return data[_HEADER.size :]
    return None


def depth_parameters(data: bytes) -> tuple[float, float]:
    """Return the quantization parameters of a compressed depth image with at least 12 bytes."""
    _, first, second = _HEADER.unpack_from(data)
    return first, second


def depth_from_inverse(
    values: npt.NDArray[np.uint16], parameters: tuple[float, float]
) -> npt.NDArray[np.float64]:
    """Return the depth in m of quantized inverse depth; 0 means that there is no measurement."""
    first, second = parameters
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = first / (values.astype(np.float64) - second)
    return np.where(values == 0, 0, depth)


def run_length_depth(data: bytes) -> npt.NDArray[np.uint16]:
    """Return the depth values of a payload in the format RVL, of shape (height, width).

    A payload alternates runs of zeros and runs of differences. Each number is a sequence of 4-bit groups, three bits of
    value and one bit that announces another group; the groups fill little-endian 32-bit words from the top.

    Raises:
        ViewError: The payload is truncated, or its sizes are not credible.
    """
    start = _HEADER.size + _SIZES.size
    if len(data) < start:
        raise ViewError(f"the compressed depth image has only {len(data)} bytes")
    width, height = _SIZES.unpack_from(data, _HEADER.size)
    if not 0 < width * height <= _LARGEST:
        raise ViewError(f"the compressed depth image has {width} x {height} pixels")
    numbers = _group_numbers(data[start : start + (len(data) - start) // 4 * 4])
    depth = np.zeros(width * height, np.int64)
    pixel = at = 0
    previous = 0
    while pixel < depth.size:
        if at + 1 >= len(numbers):
            raise ViewError(f"the compressed depth image ends after {pixel} of {depth.size} pixels")
        pixel += int(numbers[at])
        count = int(numbers[at + 1])
        codes = numbers[at + 2 : at + 2 + count]
        if len(codes) < count or pixel + count > depth.size:
            raise ViewError(f"the compressed depth image ends after {pixel} of {depth.size} pixels")
        differences = (codes >> 1) ^ -(codes & 1)
        depth[pixel : pixel + count] = previous + np.cumsum(differences)
        previous = int(depth[pixel + count - 1]) if count else previous
        pixel += count
        at += 2 + count
    return depth.astype(np.uint16).reshape(height, width)


def raw_samples(image: RawImage) -> Samples:
    """Return the samples of a raw image in their recorded depth; mosaics and YUV are converted to RGB.

    Raises:
        ViewError: The encoding is unknown, or the buffer is too short.
    """
    encoding = image.encoding.strip()
    if image.width <= 0 or image.height <= 0:
        raise ViewError(f"the image has {image.width} x {image.height} pixels")
    if encoding in _COLORS:
        order, kind = _COLORS[encoding]
        return Samples(_ordered(_samples(image, kind, len(order)), order))
    if encoding in {"mono8", "mono16", "8UC1", "8UC", "8UC01"}:
        return Samples(_samples(image, "u2" if encoding == "mono16" else "u1", 1)[..., 0])
    bayer = _BAYER.fullmatch(encoding)
    if bayer is not None:
        return Samples(demosaic(_samples(image, f"u{int(bayer[2]) // 8}", 1)[..., 0], bayer[1]))
    if encoding in _YUV:
        return Samples(_YUV[encoding](image))
    opencv = _OPENCV.fullmatch(encoding)
    if opencv is not None and 1 <= int(opencv[2] or 1) <= len(_OPENCV_ORDER):
        return _opencv_samples(image, opencv[1], int(opencv[2] or 1))
    raise ViewError(
        f"the encoding {image.encoding!r} is not supported", hint=f"use one of {', '.join(ENCODINGS)}"
    )


def raw_pixels(image: RawImage) -> Pixels:
    """Return the pixels of a raw image as RGB; depth and other measurements are color-mapped.

    Raises:
        ViewError: The encoding is unknown, or the buffer is too short.
    """
    samples = raw_samples(image)
    values = samples.values
    if samples.is_measured:
        return color_map(np.hypot(values[..., 0], values[..., 1]) if has_colors(values) else values)
    pixels = eight_bits(values)
    return np.ascontiguousarray(pixels[..., :3]) if has_colors(pixels) else gray(pixels)


def eight_bits(values: _Array) -> Pixels:
    """Return samples as bytes: the high byte of 16-bit samples, and other numbers stretched to the range of a byte."""
    return _eight_bits(values) if values.dtype.kind == "u" else _stretched(values)


def is_bayer(encoding: str) -> str | None:
    """Return the pattern of a Bayer encoding, such as `rggb`, or None."""
    match = _BAYER.fullmatch(encoding)
    return match[1] if match else None


def has_colors(values: npt.NDArray[Any]) -> bool:
    """Return whether the last of three axes has the channels of colors."""
    return values.ndim == _COLOR_AXES


def gray(values: Pixels) -> Pixels:
    """Return gray values of shape (height, width) as RGB."""
    return np.repeat(values[..., np.newaxis], 3, axis=2)


def demosaic(mosaic: _Array, pattern: str) -> _Array:
    """Return the colors of a Bayer mosaic of shape (height, width) with its sample type, interpolated from neighboring pixels.

    `pattern` has the colors of the first two rows, such as `rggb`.
    """
    height, width = mosaic.shape
    pixels = np.empty((height, width, 3), mosaic.dtype)
    for channel, color in enumerate("rgb"):
        mask = np.zeros((height, width), np.float32)
        for at, letter in enumerate(pattern):
            if letter == color:
                mask[at // 2 :: 2, at % 2 :: 2] = 1
        values = _blur(mask * mosaic) / np.maximum(_blur(mask), 1e-6)
        pixels[..., channel] = np.where(mask > 0, mosaic, np.rint(values))
    return pixels


def _group_numbers(words: bytes) -> npt.NDArray[np.int64]:
    """Return the numbers that 4-bit groups encode, least significant group first."""
    values = np.frombuffer(words, "<u4")
    groups = (
        ((values[:, np.newaxis] >> np.arange(28, -4, -4, dtype=np.uint32)) & 0xF).ravel().astype(np.int64)
    )
    last = groups < 8  # noqa: PLR2004 - the highest of four bits announces another group
    ends = np.flatnonzero(last)
    if not ends.size:
        return np.empty(0, np.int64)
    groups = groups[: ends[-1] + 1]
    starts = np.concatenate(([0], ends[:-1] + 1))
    lengths = ends - starts + 1
    shifts = 3 * (np.arange(groups.size) - np.repeat(starts, lengths))
    return np.add.reduceat((groups & 7) << shifts, starts)


def _blur(values: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.floating[Any]]:
    """Return the sums of 3 x 3 neighbors with the weights 1, 2, 1 along each axis."""
    padded = np.pad(values, 1)
    rows = padded[:-2] + 2 * padded[1:-1] + padded[2:]
    return rows[:, :-2] + 2 * rows[:, 1:-1] + rows[:, 2:]


def _samples(image: RawImage, kind: str, channels: int) -> _Array:
    """Return the samples of shape (height, width, channels), in the byte order of this machine."""
    item = np.dtype(kind).newbyteorder(">" if image.is_bigendian else "<")
    rows = _rows(image, image.width * channels * item.itemsize, image.height)
    samples = np.ascontiguousarray(rows).view(item).reshape(image.height, image.width, channels)
    return samples.astype(item.newbyteorder("="), copy=False)


def _rows(image: RawImage, row_bytes: int, height: int) -> npt.NDArray[np.uint8]:
    """Return the first `used` bytes of each row, of shape (height, used)."""
    stride = image.stride if image.stride and height > 1 else row_bytes
    if image.stride and image.stride < row_bytes:
        raise ViewError(
            f"a row of {image.width} pixels in {image.encoding} has {row_bytes} bytes, but the stride is {image.stride}"
        )
    data = np.frombuffer(image.data, np.uint8)
    needed = stride * (height - 1) + row_bytes
    if data.size < needed:
        size = f"{image.width} x {image.height}"
        raise ViewError(
            f"an image of {size} pixels in {image.encoding} has {needed} bytes, found {data.size}"
        )
    if data.size < stride * height:  # the last row need not be padded
        data = np.pad(data, (0, stride * height - data.size))
    return data[: stride * height].reshape(height, stride)[:, :row_bytes]


def _eight_bits(samples: _Array) -> Pixels:
    return samples if samples.dtype.itemsize == 1 else (samples >> _EIGHT_BITS).astype(np.uint8)


def _ordered(samples: _Array, order: str) -> _Array:
    """Return the channels as RGB or RGBA."""
    colors = "rgba"[: len(order)]
    if order == colors:
        return samples
    return np.ascontiguousarray(samples[..., [order.index(color) for color in colors]])


def _opencv_samples(image: RawImage, depth: str, channels: int) -> Samples:
    """Return the samples of an OpenCV matrix: three or four channels are colors in OpenCV's order."""
    samples = _samples(image, _OPENCV_TYPES[depth], channels)
    if channels > 2:  # noqa: PLR2004 - fewer channels are measurements
        return Samples(_ordered(samples, _OPENCV_ORDER[:channels]))
    return Samples(samples[..., 0] if channels == 1 else samples, is_measured=True)


def _stretched(samples: _Array) -> Pixels:
    """Return samples scaled so that the smallest finite one is 0 and the largest is 255."""
    finite = np.isfinite(samples)
    if not finite.any():
        return np.zeros(samples.shape, np.uint8)
    low, high = float(samples[finite].min()), float(samples[finite].max())
    scaled = (samples.astype(np.float64) - low) * (255 / (high - low if high > low else 1))
    return np.where(finite, scaled, 0).astype(np.uint8)


def _from_yuv(luma: _Array, blue: _Array, red: _Array) -> Pixels:
    """Return RGB for luma and chroma in the ranges of ITU-R BT.601, as OpenCV and ROS convert them."""
    y = 1.164 * (luma.astype(np.float32) - 16)
    u, v = blue.astype(np.float32) - 128, red.astype(np.float32) - 128
    pixels = np.stack([y + 1.596 * v, y - 0.813 * v - 0.391 * u, y + 2.018 * u], axis=-1)
    return np.clip(np.rint(pixels), 0, 255).astype(np.uint8)


def _packed_422(luma: int, blue: int, red: int) -> Callable[[RawImage], Pixels]:
    """Return the converter of pairs of pixels in 4 bytes; the arguments are the offsets of the first samples."""

    def convert(image: RawImage) -> Pixels:
        pairs = (image.width + 1) // 2
        quads = _rows(image, pairs * 4, image.height).reshape(image.height, pairs, 4)
        lumas = quads[..., [luma, luma + 2]].reshape(image.height, pairs * 2)
        chroma = [np.repeat(quads[..., at], 2, axis=1) for at in (blue, red)]
        return _from_yuv(lumas, *chroma)[:, : image.width]

    return convert


def _planar(blue: int, *, divisor: int = 2, interleaved: bool = True) -> Callable[[RawImage], Pixels]:
    """Return the converter of a luma plane that is followed by chroma at 1 / `divisor` of its resolution.

    `blue` is the position of the blue chroma: 0 if it precedes the red chroma, otherwise 1.
    """

    def convert(image: RawImage) -> Pixels:
        width, height = -(-image.width // divisor), -(-image.height // divisor)
        stride = image.stride or image.width
        lumas = _rows(image, image.width, image.height)
        chroma_bytes = np.frombuffer(image.data, np.uint8)[stride * image.height :]
        chroma_stride = -(-stride // divisor)
        row_bytes = chroma_stride * 2 if interleaved else chroma_stride
        plane_rows = height if interleaved else height * 2
        if chroma_bytes.size < row_bytes * plane_rows:
            raise ViewError(
                f"the chroma of {image.encoding} has {row_bytes * plane_rows} bytes, found {chroma_bytes.size}"
            )
        rows = chroma_bytes[: row_bytes * plane_rows].reshape(plane_rows, row_bytes)
        planes = (
            [rows[:, at : 2 * width : 2] for at in (0, 1)] if interleaved else [rows[:height], rows[height:]]
        )
        full = [
            plane[:, :width].repeat(divisor, axis=0).repeat(divisor, axis=1)[: image.height, : image.width]
            for plane in planes
        ]
        return _from_yuv(lumas, full[blue], full[1 - blue])

    return convert


def _packed_444(image: RawImage) -> Pixels:
    samples = _samples(image, "u1", 3)
    return _from_yuv(samples[..., 0], samples[..., 1], samples[..., 2])


_UYVY, _YUYV = _packed_422(1, 0, 2), _packed_422(0, 1, 3)


_YUV: dict[str, Callable[[RawImage], Pixels]] = {
    "uyvy": _UYVY,
    "yuv422": _UYVY,
    "yuyv": _YUYV,
    "yuv422_yuy2": _YUYV,
    "nv12": _planar(0),
    "nv21": _planar(1),
    "nv24": _planar(0, divisor=1),
    "i420": _planar(0, interleaved=False),
    "yv12": _planar(1, interleaved=False),
    "yuv444": _packed_444,
}


ENCODINGS = (
    *_COLORS,
    *("mono8", "mono16"),
    *(f"bayer_{pattern}{bits}" for pattern in ("rggb", "bggr", "gbrg", "grbg") for bits in (8, 16)),
    *_YUV,
    *(f"{depth}C1..4" for depth in _OPENCV_TYPES),
)
"""The supported encodings; OpenCV's have 1 to 4 channels."""

_PNG_LEVEL, _PNG_RUN_LENGTHS = 1, 3
"""The fastest level of zlib, and its strategy that searches only for repetitions of one byte: after PNG's filters, this takes
three quarters of the default's time and makes photos 12 % smaller."""
_MAX_DEPTH = 0xFFFF
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GRAY_8_BIT = bytes((8, 0, 0, 0, 0))


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
