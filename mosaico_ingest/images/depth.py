"""Depth images: the color map, and the payloads of the ROS plugin `compressed_depth_image_transport`."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from mosaico_ingest.errors import ViewError

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
