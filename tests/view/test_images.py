"""Images: each encoding gives the colors of the picture that was encoded."""

from __future__ import annotations

import io
import struct
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pytest
from PIL import Image

from mosaico_ingest.errors import ViewError
from mosaico_ingest.images import color_map, run_length_depth
from mosaico_ingest.view.pictures import contact_sheet, decode_image, fit_pixels, has_images, png_bytes

HEIGHT, WIDTH = 6, 8
RED, GREEN, BLUE = (200, 30, 20), (20, 180, 40), (10, 20, 220)


def picture() -> npt.NDArray[np.uint8]:
    """Return red at the top left, green at the top right, blue at the bottom: a flip or a swap changes it."""
    pixels = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    pixels[: HEIGHT // 2, : WIDTH // 2] = RED
    pixels[: HEIGHT // 2, WIDTH // 2 :] = GREEN
    pixels[HEIGHT // 2 :] = BLUE
    return pixels


def row(data: npt.NDArray[Any] | bytes, encoding: str, *, stride: int = 0, **columns: Any) -> dict[str, Any]:
    raw = data if isinstance(data, bytes) else data.tobytes()
    size = {"width": WIDTH, "height": HEIGHT, "stride": stride or len(raw) // HEIGHT}
    return {"data": raw, "format": "raw", "encoding": encoding, **size, **columns}


def luma_and_chroma() -> npt.NDArray[np.uint8]:
    """Return Y, Cb, Cr of BT.601 in studio range, pixel by pixel."""
    coded = np.empty((HEIGHT, WIDTH, 3))
    for y, line in enumerate(picture().astype(float)):
        for x, (r, g, b) in enumerate(line):
            coded[y, x] = (
                16 + 0.257 * r + 0.504 * g + 0.098 * b,
                128 - 0.148 * r - 0.291 * g + 0.439 * b,
                128 + 0.439 * r - 0.368 * g - 0.071 * b,
            )
    return np.rint(coded).astype(np.uint8)


@pytest.mark.parametrize("order", ["rgb", "bgr", "rgba", "bgra"])
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("byte_order", ["<", ">"])
def test_decode_image_color_encoding_returns_rgb(order: str, bits: int, byte_order: str) -> None:
    channels = np.stack(
        [picture()[..., "rgb".index(c)] if c != "a" else np.zeros_like(picture()[..., 0]) for c in order], -1
    )
    samples = channels if bits == 8 else (channels.astype(np.uint16) << 8) + 7
    stored = samples.astype(samples.dtype.newbyteorder(byte_order))
    decoded = decode_image(row(stored, f"{order}{bits}", is_bigendian=byte_order == ">"))
    assert np.array_equal(decoded, picture())


@pytest.mark.parametrize(("encoding", "order"), [("8UC3", "bgr"), ("8UC4", "bgra")])
def test_decode_image_opencv_colors_are_in_order_of_opencv(encoding: str, order: str) -> None:
    samples = np.dstack([picture()[..., ["rgb".index(c)]] if c != "a" else picture()[..., :1] for c in order])
    assert np.array_equal(decode_image(row(samples, encoding)), picture())


@pytest.mark.parametrize("encoding", ["mono8", "8UC1", "mono16"])
def test_decode_image_grey_encoding_returns_grey(encoding: str) -> None:
    values = picture()[..., 0]
    samples = values if encoding != "mono16" else values.astype("<u2") << 8
    assert np.array_equal(decode_image(row(samples, encoding)), np.dstack([values] * 3))


def test_decode_image_padded_rows_ignores_padding() -> None:
    padded = np.pad(picture().reshape(HEIGHT, -1), ((0, 0), (0, 5)), constant_values=99)
    data = padded.tobytes()
    assert np.array_equal(decode_image(row(data, "rgb8", stride=WIDTH * 3 + 5)), picture())
    assert np.array_equal(decode_image(row(data[:-5], "rgb8", stride=WIDTH * 3 + 5)), picture())


def test_decode_image_ros_field_step_is_stride() -> None:
    columns = row(picture(), "rgb8")
    step = columns.pop("stride")
    del columns["format"]
    assert np.array_equal(decode_image({**columns, "step": step}), picture())


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [8, 16])
def test_decode_image_bayer_of_one_color_returns_color_everywhere(pattern: str, bits: int) -> None:
    mosaic = np.empty((HEIGHT, WIDTH), np.uint8)
    for at, letter in enumerate(pattern):
        mosaic[at // 2 :: 2, at % 2 :: 2] = RED["rgb".index(letter)]
    samples = mosaic if bits == 8 else mosaic.astype("<u2") << 8
    decoded = decode_image(row(samples, f"bayer_{pattern}{bits}"))
    assert np.array_equal(decoded, np.full((HEIGHT, WIDTH, 3), RED))


def test_decode_image_bayer_interpolates_between_neighbors() -> None:
    mosaic = np.zeros((HEIGHT, WIDTH), np.uint8)
    mosaic[0::2, 0::2] = np.arange(0, WIDTH, 2) * 10  # the red pixels of rggb
    decoded = decode_image(row(mosaic, "bayer_rggb8"))
    assert decoded[0, :7, 0].tolist() == [0, 10, 20, 30, 40, 50, 60]
    assert decoded[1, 2].tolist() == [20, 0, 0]


@pytest.mark.parametrize("encoding", ["uyvy", "yuv422", "yuyv", "yuv422_yuy2", "yuv444"])
def test_decode_image_packed_yuv_returns_colors(encoding: str) -> None:
    y, u, v = np.moveaxis(luma_and_chroma(), -1, 0)
    quads = {
        "uyvy": (u[:, ::2], y[:, ::2], v[:, ::2], y[:, 1::2]),
        "yuyv": (y[:, ::2], u[:, ::2], y[:, 1::2], v[:, ::2]),
        "yuv444": (y, u, v),
    }
    layout = {"yuv422": "uyvy", "yuv422_yuy2": "yuyv"}.get(encoding, encoding)
    decoded = decode_image(row(np.dstack(quads[layout]), encoding))
    assert np.abs(decoded.astype(int) - picture()).max() <= 3


@pytest.mark.parametrize("encoding", ["nv12", "nv21", "nv24", "i420", "yv12"])
@pytest.mark.parametrize("height", [HEIGHT, HEIGHT - 1])
def test_decode_image_planar_yuv_returns_colors(encoding: str, height: int) -> None:
    y, u, v = (plane.copy() for plane in np.moveaxis(luma_and_chroma(), -1, 0))
    if encoding != "nv24":  # the middle rows have chroma of two colors
        u, v = u[::2, ::2], v[::2, ::2]
    planes = {
        "nv12": np.dstack([u, v]),
        "nv21": np.dstack([v, u]),
        "nv24": np.dstack([u, v])[:height],
        "i420": np.stack([u, v]),
        "yv12": np.stack([v, u]),
    }
    data = y[:height].tobytes() + planes[encoding].tobytes()
    decoded = decode_image(row(data, encoding, stride=WIDTH, height=height))
    rows = [0, 1, HEIGHT - 2]
    assert decoded.shape == (height, WIDTH, 3)
    assert np.abs(decoded[rows].astype(int) - picture()[:height][rows]).max() <= 3


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1", "64FC1", "32SC1", "16SC1"])
def test_decode_image_depth_maps_near_to_blue_and_far_to_red(encoding: str) -> None:
    kind = {"16UC1": "<u2", "32FC1": "<f4", "64FC1": "<f8", "32SC1": "<i4", "16SC1": "<i2"}[encoding]
    depth = np.linspace(1, 5000, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    depth[0, 0] = 0
    decoded = decode_image(row(depth.astype(kind), encoding)).astype(int)
    assert decoded[0, 0].tolist() == [0, 0, 0]
    near, middle, far = decoded[0, 1], decoded[HEIGHT // 2, 0], decoded[-1, -1]
    assert near[2] > near[0]
    assert middle[1] > max(middle[0], middle[2])
    assert far[0] > far[2]


def test_color_map_without_finite_values_returns_black() -> None:
    assert not color_map(np.full((2, 2), np.nan)).any()
    assert not color_map(np.zeros((2, 2))).any()
    assert color_map(np.full((2, 2), 7.0)).any()


@pytest.mark.parametrize("kind", ["PNG", "WEBP", "BMP", "TIFF"])
def test_decode_image_image_file_returns_its_pixels(kind: str) -> None:
    buffer = io.BytesIO()
    options = {"lossless": True} if kind == "WEBP" else {}
    Image.fromarray(picture()).save(buffer, kind, **options)
    assert np.array_equal(
        decode_image({"data": buffer.getvalue(), "format": kind.lower()}, ros_format="rgb8; x"), picture()
    )


def test_decode_image_jpeg_returns_its_pixels() -> None:
    buffer = io.BytesIO()
    large = picture().repeat(16, axis=0).repeat(16, axis=1)
    Image.fromarray(large).save(buffer, "JPEG", quality=95)
    decoded = decode_image({"data": buffer.getvalue(), "format": "jpeg"})
    assert np.abs(decoded[8, 8].astype(int) - RED).max() < 12
    assert np.abs(decoded[8, -8].astype(int) - GREEN).max() < 12


def test_decode_image_bayer_picture_in_image_file_is_demosaiced() -> None:
    mosaic = np.zeros((HEIGHT, WIDTH), np.uint8)
    mosaic[0::2, 0::2] = 200
    buffer = io.BytesIO()
    Image.fromarray(mosaic).save(buffer, "PNG")
    decoded = decode_image(
        {"data": buffer.getvalue(), "format": "png"}, ros_format="bayer_rggb8; png compressed"
    )
    assert np.array_equal(decoded, np.full((HEIGHT, WIDTH, 3), (200, 0, 0)))


def test_decode_image_raw_buffer_stored_as_png_returns_its_pixels() -> None:
    buffer = io.BytesIO()
    Image.fromarray(picture().reshape(HEIGHT, -1)).save(buffer, "PNG")
    columns = {"format": "png", "stride": WIDTH * 3}
    assert np.array_equal(decode_image({**row(buffer.getvalue(), "rgb8"), **columns}), picture())


def depth_file(values: npt.NDArray[np.uint16]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(values).save(buffer, "PNG")
    return buffer.getvalue()


def test_decode_image_compressed_depth_equals_raw_depth() -> None:
    depth = np.linspace(500, 4000, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH).astype(np.uint16)
    data = struct.pack("<iff", 0, 0, 0) + depth_file(depth)
    decoded = decode_image({"data": data, "format": "png"}, ros_format="16UC1; compressedDepth png")
    assert np.array_equal(decoded, color_map(depth))


def test_decode_image_inverse_depth_restores_meters() -> None:
    depth = np.linspace(0.5, 8, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    first, second = 100.0 * 101.0, 1 - 101.0 * 100.0 / 10.0
    codes = np.rint(first / depth + second).astype(np.uint16)
    data = struct.pack("<iff", 0, first, second) + depth_file(codes)
    decoded = decode_image({"data": data, "format": "png"}, ros_format="32FC1; compressedDepth png")
    assert np.abs(decoded.astype(int) - color_map(depth)).max() <= 3


def run_length(depth: list[int]) -> bytes:
    """Encode depth as the authors of RVL do, one number after the other."""
    groups: list[int] = []

    def write(value: int) -> None:
        while True:
            group, value = value & 7, value >> 3
            groups.append(group | (8 if value else 0))
            if not value:
                return

    at = previous = 0
    while at < len(depth):
        zeros = at
        while at < len(depth) and depth[at] == 0:
            at += 1
        write(at - zeros)
        start = at
        while at < len(depth) and depth[at]:
            at += 1
        write(at - start)
        for value in depth[start:at]:
            difference = value - previous
            write((difference << 1) ^ (difference >> 31))
            previous = value
    groups += [0] * (-len(groups) % 8)
    words = (int("".join(f"{group:x}" for group in groups[i : i + 8]), 16) for i in range(0, len(groups), 8))
    return b"".join(struct.pack("<I", word) for word in words)


@pytest.mark.parametrize("starts_with", [0, 700])
def test_run_length_depth_returns_encoded_values(starts_with: int) -> None:
    depth = [starts_with, 0, 0, 800, 65535, 1, 0, 3, 3, 0, 0, 9]
    data = struct.pack("<iffII", 0, 0, 0, 4, 3) + run_length(depth)
    assert run_length_depth(data).tolist() == np.reshape(depth, (3, 4)).tolist()
    decoded = decode_image({"data": data, "format": "raw"}, ros_format="16UC1; compressedDepth rvl")
    assert np.array_equal(decoded, color_map(np.reshape(depth, (3, 4))))


@pytest.mark.parametrize("size", [3, 12, 20, 22])
def test_run_length_depth_truncated_payload_raises(size: int) -> None:
    data = struct.pack("<iffII", 0, 0, 0, 4, 3) + run_length([5] * 12)
    with pytest.raises(ViewError):
        run_length_depth(data[:size])


@pytest.mark.parametrize(
    "columns",
    [
        {"encoding": "rgb9"},
        {"encoding": "rgb8", "data": b"short"},
        {"encoding": "rgb8", "stride": 3},
        {"encoding": "rgb8", "width": 0},
        {"encoding": "rgb8", "data": b""},
        {"encoding": "rgb8", "data": None},
        {"encoding": "nv12", "stride": 8, "data": bytes(8 * 6)},
        {"encoding": None, "format": "jpeg", "data": b"no image"},
        {"encoding": None, "format": "h264", "data": b"\0\0\0\1"},
    ],
)
def test_decode_image_unusable_row_raises_view_error(columns: dict[str, Any]) -> None:
    with pytest.raises(ViewError):
        decode_image({**row(picture(), "rgb8"), **columns})


def test_decode_image_truncated_file_raises_view_error() -> None:
    noise = np.random.default_rng(1).integers(0, 255, (64, 64, 3), np.uint8)
    with pytest.raises(ViewError):
        decode_image({"data": png_bytes(noise)[:900], "format": "png"})


def test_png_bytes_returns_the_same_pixels() -> None:
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(png_bytes(picture())))), picture())


def test_fit_pixels_keeps_proportions_and_never_enlarges() -> None:
    large = picture().repeat(10, axis=0).repeat(10, axis=1)
    assert fit_pixels(large, width=40, height=1000).shape == (30, 40, 3)
    assert fit_pixels(picture(), width=100, height=100).shape == picture().shape


def test_contact_sheet_arranges_pictures_in_rows() -> None:
    large = picture().repeat(20, axis=0).repeat(20, axis=1)
    sheet = contact_sheet([(f"+{n} s", large) for n in range(5)], columns=3, width=80)
    assert sheet.shape == (4 + 2 * (60 + 24), 4 + 3 * 84, 3)
    assert sheet[10, 10].tolist() == list(RED)
    assert contact_sheet([("", large)], columns=3, width=80).shape[1] == 88


def test_has_images_needs_bytes_and_encoding_or_format() -> None:
    size = [("width", pa.int32()), ("height", pa.int32())]
    assert has_images(pa.schema([("data", pa.binary()), ("encoding", pa.string()), *size]))
    assert has_images(pa.schema([("data", pa.large_binary()), ("format", pa.string())]))
    assert not has_images(pa.schema([("data", pa.list_(pa.int8())), ("format", pa.string())]))
    assert not has_images(pa.schema([("data", pa.binary())]))
