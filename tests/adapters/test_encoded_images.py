"""The setting `image`: rows with image files, rejected images, and their accounting in runs and exports."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_recordings import record
from PIL import Image

from mosaico_ingest import api
from mosaico_ingest.adapters.adapter import Adapted, EncodedImageSpec, without_files
from mosaico_ingest.adapters.builtin import BY_NAME
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import IngestError
from mosaico_ingest.job.fields import ImageFormat, ImageSettings
from mosaico_ingest.pipeline.run import make_plan, run_recording
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.rosbag.definitions.model import Definition
from mosaico_ingest.view.pictures import decode_image

Adapt = Callable[..., Adapted]
Define = Callable[..., Definition]


HEADER = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "camera"}


def rgb(value: int, *, width: int = 2, height: int = 2, **fields: Any) -> dict[str, Any]:
    data = bytes([value, 2 * value % 256, 255 - value] * (width * height))
    size = {"width": width, "height": height, "step": width * 3}
    return {"header": HEADER, "encoding": "rgb8", "is_bigendian": 0, "data": data, **size, **fields}


def adapted(
    define: Define, adapt: Adapt, messages: Sequence[dict[str, Any]], settings: ImageSettings
) -> Adapted:
    spec = EncodedImageSpec(BY_NAME["ImageAdapter"], settings)
    return adapt(spec, define("sensor_msgs/msg/Image"), messages)


def first_pixel(file: bytes) -> tuple[int, ...]:
    pixel = Image.open(io.BytesIO(file)).getpixel((0, 0))
    assert isinstance(pixel, tuple)
    return pixel


def test_png_of_other_order_stores_layout_of_decoded_file(define: Define, adapt: Adapt) -> None:
    message = rgb(9, encoding="bgr8", step=8, data=bytes([1, 2, 3, 4, 5, 6, 0, 0] * 2), is_bigendian=1)
    (row,) = adapted(define, adapt, [message], ImageSettings(format="png")).rows.to_pylist()
    assert first_pixel(row["data"]) == (3, 2, 1)
    layout = [row[name] for name in ("format", "encoding", "width", "height", "stride", "is_bigendian")]
    assert layout == ["png", "rgb8", 2, 2, 6, False]
    assert row["header"]["frame_id"] == "camera"


def test_batch_larger_than_threads_keeps_order_and_rejects_only_unsuitable_images(
    define: Define, adapt: Adapt, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 4)
    messages = [rgb(value, width=200, height=100) for value in range(40)]
    for row in (3, 17, 39):
        messages[row] = {**messages[row], "encoding": "rgb16"}
    messages[20] = {**messages[20], "data": b"short"}
    result = adapted(define, adapt, messages, ImageSettings(format="png"))
    assert [(failure.row, failure.rule) for failure in result.failures] == [
        (row, "image-encoding") for row in (3, 17, 20, 39)
    ]
    kept = [row for row in range(40) if row not in {3, 17, 20, 39}]
    assert result.index.tolist() == kept
    assert [first_pixel(row["data"])[0] for row in result.rows.to_pylist()] == kept


def test_encoded_images_stay_unchanged(define: Define, adapt: Adapt) -> None:
    png = EncodedImageSpec(BY_NAME["ImageAdapter"], ImageSettings(format="png"))
    definition = define("sensor_msgs/msg/Image")
    twice = EncodedImageSpec(png, ImageSettings(format="jpeg"))
    assert adapt(twice, definition, [rgb(1)]).rows.equals(adapt(png, definition, [rgb(1)]).rows)


@pytest.mark.parametrize("message", [rgb(1, data=b"abc"), rgb(1, height=0, width=0, step=0, data=b"")])
def test_buffer_png_of_wrong_size_stays_raw(define: Define, adapt: Adapt, message: dict[str, Any]) -> None:
    (row,) = adapted(define, adapt, [message], ImageSettings(format="buffer_png")).rows.to_pylist()
    assert (row["format"], row["data"], row["stride"]) == ("raw", message["data"], message["step"])


def test_other_ontology_is_unchanged(define: Define, adapt: Adapt) -> None:
    definition = define("sensor_msgs/msg/Imu")
    row = {"linear_acceleration": {"x": 1.0}, "angular_velocity": {"x": 2.0}}
    plain = adapt(BY_NAME["IMUAdapter"], definition, [row])
    assert len(plain.rows) == 1
    spec = EncodedImageSpec(BY_NAME["IMUAdapter"], ImageSettings(format="jpeg"))
    assert adapt(spec, definition, [row]).rows.equals(plain.rows)


@pytest.mark.parametrize("name", ["png", "buffer_png", "jpeg"])
def test_without_files_restores_raw_images(define: Define, adapt: Adapt, name: ImageFormat) -> None:
    messages = [rgb(90, width=16, height=16), rgb(120, width=16, height=16, encoding="bgr8")]
    rows = without_files(adapted(define, adapt, messages, ImageSettings(format=name)).rows).to_pylist()
    shown = [decode_image({**message, "stride": message["step"]}) for message in messages]
    for row, pixels in zip(rows, shown, strict=True):
        assert (row["format"], row["stride"]) == ("raw", 48)
        difference = np.abs(decode_image(row).astype(int) - pixels)
        assert difference.max() <= (2 if name == "jpeg" else 0)


@pytest.mark.parametrize("name", ["png", "jpeg"])
def test_missing_pillow_names_extra_before_any_image(
    define: Define, adapt: Adapt, monkeypatch: pytest.MonkeyPatch, name: ImageFormat
) -> None:
    monkeypatch.setitem(sys.modules, "PIL.Image", None)
    with pytest.raises(IngestError) as raised:
        adapted(define, adapt, [], ImageSettings(format=name))
    assert "mosaico-ingest[images]" in str(raised.value.hint)


def test_buffer_png_does_not_need_pillow(
    define: Define, adapt: Adapt, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "PIL.Image", None)
    (row,) = adapted(define, adapt, [rgb(1)], ImageSettings(format="buffer_png")).rows.to_pylist()
    assert row["format"] == "png"


@pytest.fixture
def cameras(tmp_path: Path, define: Define) -> Path:
    """Write a recording with a color camera, a depth camera with one image of another type, and a compressed camera."""
    raw, compressed = define("sensor_msgs/msg/Image"), define("sensor_msgs/msg/CompressedImage")
    depth = np.arange(12, dtype="<f4").reshape(3, 4)
    messages: list[Any] = []
    for at in range(6):
        fields = rgb(0, width=4, height=3, step=16, encoding="32FC1", data=(depth + at).tobytes())
        if at == 2:
            fields["encoding"] = "32SC1"
        messages += [
            ("/cam/color", raw, 3 * at, rgb(10 * at, width=64, height=32)),
            ("/cam/depth", raw, 3 * at + 1, fields),
            (
                "/cam/jpeg",
                compressed,
                3 * at + 2,
                {"header": HEADER, "format": "jpeg", "data": bytes([255, 216, 255, at])},
            ),
        ]
    return record(tmp_path / "cameras.mcap", messages)


def job(recording: Path, image: object, **keys: object) -> Task:
    manifest = {
        "bag": {"path": recording.name},
        "sequence": {"name": "s"},
        "target": {"store": "store"},
        "topic_settings": image,
        **keys,
    }
    path = recording.with_name("job.yaml")
    path.write_text(json.dumps(manifest))
    return Task(api.compile_job(path)[0])


def stored(recording: Path, topic: str) -> list[dict[str, Any]]:
    return Store.open(recording.parent / "store").topic("s", topic).to_arrow().to_pylist()


def test_run_stores_pictures_counts_rejected_images_and_keeps_compressed_images(cameras: Path) -> None:
    settings = {
        "/cam/color": {"image": {"format": "jpeg", "quality": 95, "max_width": 16}},
        "/cam/*": {"image": {"format": "png", "depth_unit": 0.01}},
    }
    outcome = run_recording(job(cameras, settings, on_error={"topic": "ignore"}))
    report = outcome.report
    color, depth, jpeg = (stored(cameras, f"/cam/{name}") for name in ("color", "depth", "jpeg"))
    assert [(row["format"], row["encoding"], row["width"], row["height"]) for row in color] == [
        ("jpeg", "rgb8", 16, 8)
    ] * 6
    for at, row in enumerate(color):
        assert np.abs(np.subtract(first_pixel(row["data"]), (10 * at, 20 * at, 255 - 10 * at))).max() <= 3
    values = [np.asarray(Image.open(io.BytesIO(row["data"]))).tolist() for row in depth]
    expected = (np.arange(12).reshape(3, 4) * 100).tolist()
    assert values == [[[each + 100 * at for each in line] for line in expected] for at in (0, 1, 3, 4, 5)]
    assert [row["data"] for row in jpeg] == [bytes([255, 216, 255, at]) for at in range(6)]
    topics = {topic.topic: topic for topic in report.topics}
    assert (topics["/cam/depth"].read, topics["/cam/depth"].written, topics["/cam/depth"].rejected) == (
        6,
        5,
        1,
    )
    assert [each.rule for each in topics["/cam/depth"].rejections] == ["image-encoding"]
    store = Store.open(cameras.parent / "store")
    assert store.topic("s", "/cam/color").metadata["_image_"] == {
        "format": "jpeg", "quality": 95, "max_width": 16,
        "source_encoding": "rgb8", "source_width": 64, "source_height": 32,
    }  # fmt: skip
    assert store.topic("s", "/cam/depth").metadata["_image_"]["depth_unit"] == 0.01
    assert "_image_" not in store.topic("s", "/cam/jpeg").metadata


def test_plan_reports_setting_that_matches_only_compressed_images(cameras: Path) -> None:
    plan = make_plan(job(cameras, {"/cam/jpeg": {"image": {"format": "jpeg"}}}))
    assert [finding.rule for finding in plan.findings] == ["image-setting"]


def test_manifest_with_setting_of_another_format_is_refused(cameras: Path) -> None:
    with pytest.raises(IngestError) as raised:
        job(cameras, {"/cam/color": {"image": {"format": "png", "quality": 50}}})
    (finding,) = raised.value.findings
    assert finding.rule == "conflicting-keys"
