"""Stored images: CPU time and size of each format, of the conversion alone and of complete runs.

./dev bench images [--seconds N]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from measure import run, typical

from mosaico_ingest.images import RawImage, encode_image
from mosaico_ingest.job.fields import ImageSettings
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.blocks import Encoding
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.rosbags_library import open_writer
from mosaico_ingest.rosbag.serialization import Serializer

WIDTH, HEIGHT, RATE = 1280, 720, 10
ROUNDS = 3
SETTINGS = {
    "raw": ImageSettings(),
    "png": ImageSettings(format="png"),
    "jpeg, quality 90": ImageSettings(format="jpeg"),
    "jpeg, at most 640 wide": ImageSettings(format="jpeg", max_width=640),
    "buffer_png": ImageSettings(format="buffer_png"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=int, default=6)
    seconds: int = parser.parse_args().seconds
    print("| encoding | format | CPU per image | MB/s of raw data | size / raw |\n|---|---|---:|---:|---:|")
    for encoding in ("bgr8", "bayer_rggb8", "yuv422", "16UC1"):
        image = next(iter(images(encoding, 1)))
        for name, settings in SETTINGS.items():
            if name != "raw" and not (encoding == "16UC1" and settings.format == "jpeg"):
                print_conversion(image, name, settings)
    print(
        "\n| format | wall | CPU | MB/s of raw data | stored / raw | peak memory |\n|---|---:|---:|---:|---:|---:|"
    )
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "camera.mcap"
        raw_bytes = write_recording(recording, seconds * RATE)
        for name, settings in SETTINGS.items():
            print_run(recording, name, settings, raw_bytes)


def images(encoding: str, count: int) -> Iterable[RawImage]:
    """Yield pictures of a smooth moving scene with the noise of a sensor."""
    random = np.random.default_rng(1)
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    for at in range(count):
        channels = [(np.sin((x + 9 * at) / 90) + np.cos(y / 70 + c)) * 60 + 128 for c in range(3)]
        noise = random.normal(0, 3, (HEIGHT, WIDTH, 3))
        pixels = np.clip(np.stack(channels, axis=-1) + noise, 0, 255).astype(np.uint8)
        data = {
            "bgr8": lambda pixels=pixels: pixels,
            "bayer_rggb8": lambda pixels=pixels: pixels[..., 1].copy(),
            "yuv422": lambda pixels=pixels: np.ascontiguousarray(pixels[..., :2]),
            "16UC1": lambda pixels=pixels: pixels[..., 0].astype("<u2") * 20,
        }[encoding]()
        yield RawImage(data.tobytes(), WIDTH, HEIGHT, data.nbytes // HEIGHT, encoding)


def print_conversion(image: RawImage, name: str, settings: ImageSettings) -> None:
    encode_image(image, settings)
    start = time.process_time()
    files = [encode_image(image, settings) for _ in range(ROUNDS)]
    cpu_s = (time.process_time() - start) / ROUNDS
    assert files[0] is not None
    size = len(image.data)
    share = len(files[0].data) / size
    print(f"| {image.encoding} | {name} | {cpu_s * 1e3:.1f} ms | {size / cpu_s / 1e6:.0f} | {share:.2f} |")


def write_recording(path: Path, count: int) -> int:
    definition = TypeResolver(Stores.LATEST).resolve("sensor_msgs/msg/Image", None, ros_version=2)
    serializer = Serializer(definition, Encoding.CDR)
    total = 0
    with open_writer(path) as writer:
        connection = writer.add_connection("/camera", definition)
        for at, image in enumerate(images("bgr8", count)):
            stamp = {"sec": at // RATE, "nanosec": at % RATE * 10**9 // RATE}
            message = {
                "header": {"stamp": stamp, "frame_id": "camera"},
                "height": image.height,
                "width": image.width,
                "encoding": image.encoding,
                "is_bigendian": 0,
                "step": image.stride,
                "data": image.data,
            }
            writer.write(connection, at * 10**9 // RATE, serializer.from_dict(message))
            total += len(image.data)
    return total


def print_run(recording: Path, name: str, settings: ImageSettings, raw_bytes: int) -> None:
    job = recording.with_name("job.yaml")
    manifest = {
        "bag": {"path": recording.name},
        "sequence": {"if_exists": "replace"},
        "target": {"store": "store"},
        "topic_settings": {"/camera": {"image": settings.used()}},
    }
    job.write_text(json.dumps(manifest))
    command = [sys.executable, "-m", "mosaico_ingest", str(job), "-q"]
    sample = typical([run(command) for _ in range(ROUNDS)])
    segments = (recording.parent / "store" / "segments").rglob("*.parquet")
    share = sum(path.stat().st_size for path in segments) / raw_bytes
    print(
        f"| {name} | {sample.wall_s:.2f} s | {sample.cpu_s:.2f} s | {raw_bytes / sample.wall_s / 1e6:.0f} | {share:.2f} "
        f"| {sample.peak_bytes / (1 << 20):.0f} MiB |"
    )


if __name__ == "__main__":
    main()
