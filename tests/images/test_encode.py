"""Stored pictures: PNG files are exact and JPEG files similar for every encoding, compared with plain Python conversions."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from mosaico_ingest.errors import ViewError
from mosaico_ingest.images import EncodedImage, RawImage, decoded_buffer, encode_image
from mosaico_ingest.job.fields import ImageSettings

HEIGHT, WIDTH = 12, 18
Pixels = npt.NDArray[Any]
PNG, JPEG = ImageSettings(format="png"), ImageSettings(format="jpeg")


def scene() -> Pixels:
    """Return a smooth picture with different channels, whose rows and columns differ."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    red, green = 40 + 5 * x, 200 - 4 * y - x
    return np.stack([red, green, 30 + 3 * x + 4 * y], axis=-1).astype(np.uint8)


def encoded(
    data: Pixels | bytes, encoding: str, settings: ImageSettings = PNG, **layout: Any
) -> EncodedImage:
    raw = data if isinstance(data, bytes) else data.tobytes()
    size = {"width": WIDTH, "height": HEIGHT, "stride": 0, **layout}
    image = encode_image(RawImage(raw, encoding=encoding, **size), settings)
    assert image is not None
    return image


def opened(image: EncodedImage) -> Pixels:
    return np.asarray(Image.open(io.BytesIO(image.data)))


def channels(order: str, kind: str) -> Pixels:
    alpha = np.full((HEIGHT, WIDTH, 1), 77, np.uint8)
    pixels = np.concatenate([scene(), alpha], axis=-1)[..., ["rgba".index(each) for each in order]]
    return (pixels.astype(np.uint16) * 257 if kind.endswith("2") else pixels).astype(kind)


def mosaic(pattern: str) -> Pixels:
    pixels = scene()
    values = np.empty((HEIGHT, WIDTH), np.uint8)
    for y in range(HEIGHT):
        for x in range(WIDTH):
            values[y, x] = pixels[y, x, "rgb".index(pattern[y % 2 * 2 + x % 2])]
    return values


def demosaiced(values: Pixels, pattern: str) -> Pixels:
    """Return for each pixel its sample, and the mean of the samples of each other color among its neighbors."""
    pixels = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    for y in range(HEIGHT):
        for x in range(WIDTH):
            samples: dict[str, list[int]] = {"r": [], "g": [], "b": []}
            for v in range(max(0, y - 1), min(HEIGHT, y + 2)):
                for u in range(max(0, x - 1), min(WIDTH, x + 2)):
                    samples[pattern[v % 2 * 2 + u % 2]].append(int(values[v, u]))
            samples[pattern[y % 2 * 2 + x % 2]] = [int(values[y, x])]
            pixels[y, x] = [round(sum(samples[each]) / len(samples[each])) for each in "rgb"]
    return pixels


def luma_chroma() -> Pixels:
    """Return Y, Cb, Cr of BT.601; 2 x 2 pixels share their chroma."""
    coded = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    for y in range(HEIGHT):
        for x in range(WIDTH):
            r, g, b = (float(each) for each in scene()[y, x])
            coded[y, x, 0] = round(16 + 0.257 * r + 0.504 * g + 0.098 * b)
            r, g, b = (float(each) for each in scene()[y // 2 * 2, x // 2 * 2])
            coded[y, x, 1] = round(128 - 0.148 * r - 0.291 * g + 0.439 * b)
            coded[y, x, 2] = round(128 + 0.439 * r - 0.368 * g - 0.071 * b)
    return coded


def colors_of(coded: Pixels) -> Pixels:
    pixels = np.empty_like(coded)
    for y in range(HEIGHT):
        for x in range(WIDTH):
            luma, blue, red = (int(each) for each in coded[y, x])
            values = (
                1.164 * (luma - 16) + 1.596 * (red - 128),
                1.164 * (luma - 16) - 0.813 * (red - 128) - 0.391 * (blue - 128),
                1.164 * (luma - 16) + 2.018 * (blue - 128),
            )
            pixels[y, x] = [min(255, max(0, round(value))) for value in values]
    return pixels


def yuv_bytes(encoding: str) -> bytes:
    """Write the samples one after the other, as the definition of the encoding names them."""
    coded = luma_chroma()
    if encoding in {"uyvy", "yuv422", "yuyv", "yuv422_yuy2"}:
        order = (
            ((1, 0), (0, 0), (2, 0), (0, 1))
            if encoding in {"uyvy", "yuv422"}
            else ((0, 0), (1, 0), (0, 1), (2, 0))
        )
        return bytes(
            int(coded[y, x + right, channel])
            for y in range(HEIGHT)
            for x in range(0, WIDTH, 2)
            for channel, right in order
        )
    if encoding == "yuv444":
        return coded.tobytes()
    step = 1 if encoding == "nv24" else 2
    chroma = coded[::step, ::step]
    luma, blue, red = coded[..., 0].tobytes(), chroma[..., 1], chroma[..., 2]
    if encoding in {"nv12", "nv24"}:
        return luma + np.stack([blue, red], axis=-1).tobytes()
    if encoding == "nv21":
        return luma + np.stack([red, blue], axis=-1).tobytes()
    planes = (blue, red) if encoding == "i420" else (red, blue)
    return luma + b"".join(plane.tobytes() for plane in planes)


YUV = ("uyvy", "yuv422", "yuyv", "yuv422_yuy2", "nv12", "nv21", "nv24", "i420", "yv12", "yuv444")
PATTERNS = ("rggb", "bggr", "gbrg", "grbg")
PICTURES: dict[str, Callable[[], tuple[Pixels | bytes, Pixels]]] = {
    **{
        f"{order}8": lambda order=order: (channels(order, "u1"), channels("rgba"[: len(order)], "u1"))
        for order in ("rgb", "bgr", "rgba", "bgra")
    },
    "8UC3": lambda: (channels("bgr", "u1"), scene()),
    "8UC4": lambda: (channels("bgra", "u1"), channels("rgba", "u1")),
    "mono8": lambda: (scene()[..., 0].copy(), scene()[..., 0]),
    "8UC1": lambda: (scene()[..., 1].copy(), scene()[..., 1]),
    **{
        f"bayer_{pattern}8": lambda pattern=pattern: (mosaic(pattern), demosaiced(mosaic(pattern), pattern))
        for pattern in PATTERNS
    },
    **{name: lambda name=name: (yuv_bytes(name), colors_of(luma_chroma())) for name in YUV},
}
"""A raw image and the picture that it shows, by encoding."""


@pytest.mark.parametrize("encoding", PICTURES)
def test_png_of_picture_shows_its_colors(encoding: str) -> None:
    raw, expected = PICTURES[encoding]()
    image = encoded(
        raw, encoding, stride=WIDTH if encoding in {"nv12", "nv21", "nv24", "i420", "yv12"} else 0
    )
    pixels = opened(image)
    assert pixels.shape == expected.shape
    tolerance = 1 if encoding in YUV else 0  # sums of floats of 32 and 64 bits may round to neighbors
    assert np.abs(pixels.astype(int) - expected).max() <= tolerance
    count = expected.shape[2] if expected.ndim > 2 else 1
    name = {1: "mono8", 3: "rgb8", 4: "rgba8"}[count]
    layout = (image.encoding, image.width, image.height, image.stride)
    assert layout == (name, WIDTH, HEIGHT, WIDTH * count)
    assert decoded_buffer(image.data) == pixels.tobytes()


@pytest.mark.parametrize("encoding", [*PICTURES, "rgb16", "bgra16", "mono16", "bayer_rggb16"])
def test_jpeg_of_picture_is_similar(encoding: str) -> None:
    if encoding.endswith("16"):
        wide = {
            "rgb16": (channels("rgb", "u2"), scene()),
            "bgra16": (channels("bgra", "u2"), scene()),
            "mono16": (scene()[..., 0].astype(np.uint16) * 257, scene()[..., 0]),
            "bayer_rggb16": (mosaic("rggb").astype(np.uint16) * 257, demosaiced(mosaic("rggb"), "rggb")),
        }
        raw, expected = wide[encoding]
    else:
        raw, expected = PICTURES[encoding]()
    image = encoded(raw, encoding, JPEG, stride=WIDTH if encoding.startswith(("nv", "i4", "yv12")) else 0)
    pixels = opened(image)
    assert pixels.shape == (expected[..., :3] if expected.ndim > 2 else expected).shape
    error = (pixels.astype(float) - (expected[..., :3] if expected.ndim > 2 else expected)) ** 2
    assert 10 * math.log10(255**2 / error.mean()) > 34  # dB
    assert image.encoding == ("mono8" if expected.ndim == 2 else "rgb8")


@pytest.mark.parametrize("encoding", ["16UC1", "mono16"])
@pytest.mark.parametrize("is_bigendian", [False, True])
def test_png_of_16_bits_is_exact(encoding: str, *, is_bigendian: bool) -> None:
    values = np.random.default_rng(1).integers(0, 1 << 16, (HEIGHT, WIDTH)).astype(np.uint16)
    stored = values.astype(">u2" if is_bigendian else "<u2")
    image = encoded(stored, encoding, is_bigendian=is_bigendian)
    assert np.array_equal(opened(image), values)
    assert (image.encoding, image.stride, image.is_bigendian) == (encoding, WIDTH * 2, False)
    assert decoded_buffer(image.data) == values.astype("<u2").tobytes()


@pytest.mark.parametrize(("encoding", "kind"), [("32FC1", "f4"), ("64FC1", "f8")])
def test_png_of_float_depth_has_millimeters(encoding: str, kind: str) -> None:
    depth = np.random.default_rng(2).uniform(0, 65, (HEIGHT, WIDTH))
    depth[0, :3] = (math.nan, math.inf, -math.inf)
    image = encoded(depth.astype(kind), encoding)
    expected = [
        [round(value * 1000) if math.isfinite(value) else 0 for value in row]
        for row in depth.astype(kind).tolist()
    ]
    assert opened(image).tolist() == expected
    assert image.encoding == "16UC1"


def test_png_of_float_depth_out_of_range_needs_larger_unit() -> None:
    depth = np.full((HEIGHT, WIDTH), 100, np.float32)
    with pytest.raises(ViewError, match="100 m"):
        encoded(depth, "32FC1")
    image = encoded(depth, "32FC1", ImageSettings(format="png", depth_unit=0.01))
    assert (opened(image) == 10_000).all()
    with pytest.raises(ViewError, match="-1 m"):
        encoded(depth / -100, "32FC1")


@pytest.mark.parametrize(
    ("settings", "encoding", "size"),
    [
        *((PNG, name, size) for name, size in (("rgb16", 6), ("bgra16", 8), ("bayer_gbrg16", 2), ("8UC2", 2), ("16UC2", 4))),
        *((PNG, name, size) for name, size in (("16UC3", 6), ("8SC1", 1), ("16SC1", 2), ("32SC1", 4), ("32FC3", 12))),
        *((JPEG, name, size) for name, size in (("16UC1", 2), ("32FC1", 4), ("8UC2", 2), ("32FC3", 12))),
        *((settings, "jpeg2000", 3) for settings in (PNG, JPEG)),
        (PNG, "8UC5", 5),
    ],
)  # fmt: skip
def test_encoding_that_format_would_change_is_refused_by_name(
    settings: ImageSettings, encoding: str, size: int
) -> None:
    with pytest.raises(ViewError, match=encoding):
        encoded(bytes(WIDTH * HEIGHT * size), encoding, settings)


@pytest.mark.parametrize("settings", [PNG, JPEG])
@pytest.mark.parametrize(
    "layout", [{"width": 0}, {"height": 0}, {"stride": 3}, {"height": 1 << 20}, {"width": 1 << 30}]
)
def test_layout_that_contradicts_buffer_is_refused(settings: ImageSettings, layout: dict[str, int]) -> None:
    with pytest.raises(ViewError):
        encoded(scene(), "rgb8", settings, **layout)


def test_single_row_with_huge_stride_allocates_only_its_pixels() -> None:
    image = encoded(bytes(6), "rgb8", width=2, height=1, stride=(1 << 31) - 1)
    assert opened(image).shape == (1, 2, 3)


@pytest.mark.parametrize("max_width", [1, 7, 9, 17])
def test_max_width_keeps_proportions_and_colors(max_width: int) -> None:
    flat = np.full((HEIGHT, WIDTH, 3), (200, 30, 90), np.uint8)
    image = encoded(flat, "rgb8", ImageSettings(format="png", max_width=max_width))
    height = max(1, round(HEIGHT * max_width / WIDTH))
    assert (image.width, image.height, image.stride) == (max_width, height, max_width * 3)
    assert (opened(image) == (200, 30, 90)).all()


def test_max_width_of_depth_selects_recorded_values() -> None:
    values = np.random.default_rng(3).choice([0, 1000, 60_000], (HEIGHT, WIDTH)).astype(np.uint16)
    image = encoded(values, "16UC1", ImageSettings(format="png", max_width=WIDTH // 2))
    assert np.array_equal(opened(image), values[1::2, 1::2])


def test_max_width_larger_than_picture_never_enlarges() -> None:
    image = encoded(scene(), "rgb8", ImageSettings(format="png", max_width=1000))
    assert np.array_equal(opened(image), scene())


@given(data=st.data(), stride=st.integers(1, 40), height=st.integers(1, 40))
def test_buffer_png_contains_bytes_of_any_encoding(data: st.DataObject, stride: int, height: int) -> None:
    raw = data.draw(st.binary(min_size=stride * height, max_size=stride * height))
    settings = ImageSettings(format="buffer_png")
    image = encoded(raw, "anything", settings, width=1, height=height, stride=stride, is_bigendian=True)
    picture = Image.open(io.BytesIO(image.data))
    assert (picture.mode, picture.size, picture.tobytes()) == ("L", (stride, height), raw)
    assert (image.encoding, image.width, image.stride, image.is_bigendian) == ("anything", 1, stride, True)
    assert decoded_buffer(image.data) == raw


def test_decoded_buffer_of_damaged_file_raises_view_error() -> None:
    image = encoded(scene(), "rgb8")
    with pytest.raises(ViewError):
        decoded_buffer(image.data[:200])
