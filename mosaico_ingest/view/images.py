"""Images of all supported encodings as RGB pixels, PNG files, thumbnails and contact sheets."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from mosaico_ingest.errors import ViewError
from mosaico_ingest.images import (
    Pixels,
    RawImage,
    color_map,
    demosaic,
    depth_from_inverse,
    depth_parameters,
    depth_payload,
    eight_bits,
    gray,
    is_bayer,
    raw_pixels,
    run_length_depth,
)
from mosaico_ingest.images.files import file_samples, image_file_type, picture_of, pillow

_GAP = 4
"""Pixels between the pictures of a contact sheet."""
_BACKGROUND = 32
"""Gray value between the pictures of a contact sheet."""
_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")


def has_images(schema: pa.Schema) -> bool:
    """Return whether a topic with these columns contains images: bytes with a pixel encoding or a format."""
    if "data" not in schema.names or not _is_bytes(schema.field("data").type):
        return False
    if "encoding" in schema.names:
        return {"width", "height"} <= set(schema.names)
    return "format" in schema.names


def decode_image(row: Mapping[str, Any], *, ros_format: str = "") -> Pixels:
    """Return the image of a row as RGB pixels of shape (height, width, 3).

    `row` has the columns of `Image` or `CompressedImage`, or the fields of the ROS messages. `ros_format` is the format
    text of a compressed image in the topic's metadata, such as `16UC1; compressedDepth png`. Depth is color-mapped.

    Raises:
        ViewError: The encoding is not supported, or the bytes do not fit it.
        IngestError: Pillow is required and not installed.
    """
    data = row["data"]
    if not isinstance(data, bytes) or not len(data):
        raise ViewError("the row contains no image")
    encoding = row.get("encoding")
    if encoding is None:
        return _compressed_pixels(bytes(data), ros_format)
    if row.get("format") in {None, "", "raw"}:
        return raw_pixels(_raw_image(row, data))
    samples = file_samples(bytes(data))
    if samples.ndim == 2 and samples.dtype == np.uint8:  # noqa: PLR2004 - the buffer, stored as a grayscale picture
        return raw_pixels(_raw_image(row, samples.tobytes()))
    return _sample_pixels(samples, str(encoding))


def fit_pixels(pixels: Pixels, *, width: int, height: int) -> Pixels:
    """Return the picture scaled to fit into `width` x `height`, with its proportions; never enlarged.

    Raises:
        IngestError: Pillow is not installed.
    """
    picture = picture_of(pixels)
    picture.thumbnail((max(1, width), max(1, height)))
    return np.asarray(picture)


def png_bytes(pixels: Pixels) -> bytes:
    """Return the picture as a PNG file.

    Raises:
        IngestError: Pillow is not installed.
    """
    buffer = io.BytesIO()
    picture_of(pixels).save(buffer, "PNG")
    return buffer.getvalue()


def write_picture(pixels: Pixels, path: Path) -> None:
    """Write the picture as PNG, JPEG or WebP, by the suffix of the file.

    Raises:
        ViewError: The suffix is unknown.
        IngestError: Pillow is not installed.
    """
    require_suffix(path, _SUFFIXES)
    picture_of(pixels).save(path)


def require_suffix(path: Path, suffixes: Sequence[str]) -> None:
    """Check that the name of a file has one of the suffixes, in upper or lower case.

    Raises:
        ViewError: The name has another suffix.
    """
    if path.suffix.lower() not in suffixes:
        raise ViewError(
            f"{path.suffix or 'no suffix'} is no supported suffix",
            where=str(path),
            hint=f"use one of {', '.join(suffixes)}",
        )


def contact_sheet(pictures: Sequence[tuple[str, Pixels]], *, columns: int = 4, width: int = 320) -> Pixels:
    """Return one picture with small versions of all pictures in rows, each above its label.

    Raises:
        IngestError: Pillow is not installed.
    """
    image, draw = pillow("Image"), pillow("ImageDraw")
    font = pillow("ImageFont").load_default(size=14)
    thumbnails = [fit_pixels(pixels, width=width, height=width) for _, pixels in pictures]
    label_height = 20
    cell_height = max((each.shape[0] for each in thumbnails), default=0) + label_height + _GAP
    cell_width = max((each.shape[1] for each in thumbnails), default=0) + _GAP
    columns = max(1, min(columns, len(pictures)))
    rows = -(-len(pictures) // columns)
    size = (columns * cell_width + _GAP, rows * cell_height + _GAP)
    sheet = image.new("RGB", size, (_BACKGROUND,) * 3)
    pen = draw.Draw(sheet)
    for at, ((label, _), thumbnail) in enumerate(zip(pictures, thumbnails, strict=True)):
        row, column = divmod(at, columns)
        x, y = _GAP + column * cell_width, _GAP + row * cell_height
        sheet.paste(image.fromarray(thumbnail), (x, y))
        pen.text((x, y + cell_height - label_height - _GAP + 2), label, fill=(230,) * 3, font=font)
    return np.asarray(sheet)


def _is_bytes(kind: pa.DataType) -> bool:
    return pa.types.is_binary(kind) or pa.types.is_large_binary(kind) or pa.types.is_binary_view(kind)


def _raw_image(row: Mapping[str, Any], data: bytes | memoryview) -> RawImage:
    stride = row.get("stride", row.get("step"))
    return RawImage(
        data,
        width=int(row["width"]),
        height=int(row["height"]),
        stride=int(stride or 0),
        encoding=str(row["encoding"]),
        is_bigendian=bool(row.get("is_bigendian")),
    )


def _compressed_pixels(data: bytes, ros_format: str) -> Pixels:
    """Return the pixels of an image file or of a compressed depth image."""
    encoding = ros_format.partition(";")[0].strip()
    if "compressedDepth" in ros_format or depth_payload(data) is not None:
        return color_map(_compressed_depth(data, encoding, ros_format))
    return _sample_pixels(file_samples(data), encoding)


def _compressed_depth(data: bytes, encoding: str, ros_format: str) -> npt.NDArray[Any]:
    payload = depth_payload(data)
    if payload is not None:
        values = file_samples(payload)
    elif image_file_type(data) is not None:
        return file_samples(data)
    elif "rvl" in ros_format.lower():
        values = run_length_depth(data)
    else:
        raise ViewError("the compressed depth image contains neither PNG nor RVL data")
    return depth_from_inverse(values, depth_parameters(data)) if encoding == "32FC1" else values


def _sample_pixels(samples: npt.NDArray[Any], encoding: str) -> Pixels:
    """Return the samples of an image file as RGB; `encoding` is that of the image before its compression, if known."""
    if samples.ndim == 3:  # noqa: PLR2004 - height, width and channels
        return np.ascontiguousarray(samples[..., :3])
    pattern = is_bayer(encoding)
    if pattern is not None:
        return demosaic(eight_bits(samples), pattern)
    if samples.dtype == np.uint8:
        return gray(samples)
    return gray(eight_bits(samples)) if encoding == "mono16" else color_map(samples)
