"""PNG compression of raw images is lossless and applies only to supported images."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.adapters.adapter import Adapted
from mosaico_ingest.adapters.builtin import BY_NAME
from mosaico_ingest.adapters.image import PngImageSpec, grayscale_png
from mosaico_ingest.rosbag.definitions.model import Definition


def _pixels(png: bytes) -> tuple[int, int, bytes]:
    """Read back width, height and bytes of a PNG without filters, checking every chunk."""
    assert png[:8] == b"\x89PNG\r\n\x1a\n"
    at, chunks = 8, dict[bytes, bytes]()
    while at < len(png):
        size, kind = struct.unpack_from(">I4s", png, at)
        body = png[at + 8 : at + 8 + size]
        assert struct.unpack_from(">I", png, at + 8 + size)[0] == zlib.crc32(kind + body)
        chunks[kind] = body
        at += 12 + size
    width, height, depth, colour = struct.unpack_from(">IIBB", chunks[b"IHDR"])
    assert (depth, colour) == (8, 0)
    lines = zlib.decompress(chunks[b"IDAT"])
    return width, height, b"".join(lines[i + 1 : i + 1 + width] for i in range(0, len(lines), width + 1))


@given(data=st.data(), width=st.integers(1, 40), height=st.integers(1, 40))
def test_grayscale_png_round_trip_restores_bytes(data: st.DataObject, width: int, height: int) -> None:
    raw = data.draw(st.binary(min_size=width * height, max_size=width * height))
    assert _pixels(grayscale_png(raw, width=width, height=height)) == (width, height, raw)


@pytest.fixture
def images(
    define: Callable[..., Definition], adapt: Callable[..., Adapted]
) -> Callable[..., list[dict[str, Any]]]:
    def run(*messages: dict[str, Any]) -> list[dict[str, Any]]:
        spec = PngImageSpec(BY_NAME["ImageAdapter"])
        inputs = [{"encoding": "mono8", **message} for message in messages]
        return adapt(spec, define("sensor_msgs/msg/Image"), inputs).rows.to_pylist()

    return run


def test_png_images_width_is_stride(images: Callable[..., list[dict[str, Any]]]) -> None:
    (row,) = images({"height": 2, "width": 1, "step": 3, "encoding": "rgb8", "data": b"abcdef"})
    assert row["format"] == "png"
    assert _pixels(row["data"]) == (3, 2, b"abcdef")
    assert (row["width"], row["height"], row["stride"], row["encoding"]) == (1, 2, 3, "rgb8")


def test_png_images_wrong_buffer_size_stays_raw(images: Callable[..., list[dict[str, Any]]]) -> None:
    short, empty, good = images(
        {"height": 2, "width": 1, "step": 3, "data": b"abc"},
        {"height": 0, "width": 0, "step": 0, "data": b""},
        {"height": 1, "width": 1, "step": 1, "data": b"a"},
    )
    assert (short["format"], short["data"]) == ("raw", b"abc")
    assert (empty["format"], empty["data"]) == ("raw", b"")
    assert good["format"] == "png"


def test_png_images_other_ontology_is_unchanged(
    define: Callable[..., Definition], adapt: Callable[..., Adapted]
) -> None:
    definition = define("sensor_msgs/msg/Imu")
    row = {"linear_acceleration": {"x": 1.0}, "angular_velocity": {"x": 2.0}}
    plain = adapt(BY_NAME["IMUAdapter"], definition, [row])
    assert len(plain.rows) == 1
    assert adapt(PngImageSpec(BY_NAME["IMUAdapter"]), definition, [row]).rows.equals(plain.rows)
