"""Generate stand-ins of NVIDIA's R2B sequences, ingest each with its manifest in configs/r2b, and measure.

    ./dev bench r2b [SEQUENCE ...] [--scale 0.05] [--runs 3] [--data FOLDER] [--generate] [--page docs/r2b.md]

A stand-in has the topics, types, rates and storage of its sequence as far as they are known (`r2b_sequences.py`); images and
points are random. `--scale` shortens it, `--generate` only writes it, and `--page` writes the tables of the documentation, with `--runs 0` without
a measurement. Sequences are generated message by message, one after the other, and deleted after the measurement, so that `--scale 1`
needs twice the size of the largest one on disk.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import yaml
from measure import Sample, run, typical
from messages import Message, Messages
from r2b_sequences import BY_NAME, SEQUENCES, Evidence, Sequence, Topic
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg
from run import INGEST

HERE = Path(__file__).parent
MANIFESTS = HERE.parent / "configs" / "r2b"
START_NS = 1_700_000_000_000_000_000
TICKS = "std_msgs/Header header\nuint32 left_ticks\nuint32 right_ticks\nuint64 encoder_timestamp\n"
PACKAGES = {
    "BatteryState": "sensor_msgs",
    "CameraInfo": "sensor_msgs",
    "CompressedImage": "sensor_msgs",
    "EncoderTicks": "isaac_ros_nova_interfaces",
    "Image": "sensor_msgs",
    "Imu": "sensor_msgs",
    "JointState": "sensor_msgs",
    "Odometry": "nav_msgs",
    "PointCloud2": "sensor_msgs",
    "TFMessage": "tf2_msgs",
}
BYTES = {"rgb8": 3, "bgr8": 3, "mono8": 1, "16UC1": 2, "32FC1": 4}
"""Bytes per pixel of an encoding."""
POINTS, POINT_BYTES = 60_000, 16
PIXEL_SHARE = 0.37
"""Share of random bytes in a raw image that is stored uncompressed; what zstd leaves of the images of r2b_cafe."""
SMALL_BYTES = 400
"""Approximate size of a message without image or points."""
SMALL_FILE_BYTES = 50 << 20
"""Size up to which a stand-in is not shortened."""
TRAILING = bytes(4)
"""Zeros after each payload of 2023: the reader of the official SDK refuses payloads with more than three bytes left."""


def type_of(topic: Topic) -> str:
    """Return the message type of a topic."""
    name = "Image" if topic.kind.split()[0] in BYTES else topic.kind
    return f"{PACKAGES[name]}/msg/{name}"


def number_of(topic: Topic, sequence: Sequence, scale: float) -> int:
    """Return the number of messages of a topic in a stand-in."""
    count = topic.count if topic.count is not None else topic.hertz * sequence.seconds
    return max(1, round(count * (1 if topic.hertz == 0 else scale)))


def pixels_of(topic: Topic) -> tuple[str, int, int]:
    """Return the encoding, the width and the height of a raw image."""
    encoding, size = topic.kind.split()
    width, height = map(int, size.split("x"))
    return encoding, width, height


def image_bytes(topic: Topic) -> int:
    """Return the size of a raw image, 0 for other messages."""
    if topic.kind.split()[0] not in BYTES:
        return 0
    encoding, width, height = pixels_of(topic)
    return width * height * BYTES[encoding]


class StandIn:
    """The messages of one sequence, whose sizes add up to the size of its recording."""

    def __init__(self, sequence: Sequence) -> None:
        self.sequence = sequence
        self.messages = Messages(Stores.ROS2_HUMBLE, seed=sum(map(ord, sequence.name)))
        self.messages.store.register(get_types_from_msg(TICKS, "isaac_ros_nova_interfaces/msg/EncoderTicks"))
        counts = {topic.name: number_of(topic, sequence, 1) for topic in sequence.topics}
        raw = sum(image_bytes(topic) * counts[topic.name] for topic in sequence.topics)
        points = sum(counts[topic.name] for topic in sequence.topics if topic.kind == "PointCloud2")
        others = SMALL_BYTES * sum(counts.values()) + points * POINTS * POINT_BYTES
        videos = sum(counts[topic.name] for topic in sequence.topics if topic.kind == "CompressedImage")
        self.video_bytes = (sequence.file_bytes - others - raw) // videos if videos else 0
        compressed = sequence.year == 2023 and sequence.name != "r2b_hope"
        self.random_share = min(1.0, (sequence.file_bytes - others) / raw) if compressed else PIXEL_SHARE

    def write(self, folder: Path, scale: float) -> Path:
        """Write the recording below `folder`, with `metadata.yaml`, and return its folder."""
        target = folder / self.sequence.name
        shutil.rmtree(target, ignore_errors=True)
        mcap = self.sequence.file.endswith(".mcap")
        plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
        writer = Writer(target, version=9 if mcap else 8, storage_plugin=plugin)
        if not mcap and self.sequence.name != "r2b_hope":
            writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
        with writer:
            connections = {
                topic.name: writer.add_connection(topic.name, type_of(topic), typestore=self.messages.store)
                for topic in self.sequence.topics
            }
            for time_ns, topic in self._schedule(scale):
                payload = self.messages.store.serialize_cdr(self._message(topic, time_ns), type_of(topic))
                trailing = b"" if mcap else TRAILING
                writer.write(connections[topic.name], time_ns + 40_000_000, bytes(payload) + trailing)
        self._rename(target)
        if not mcap:
            _as_version_5(folder / self.sequence.file, target / "metadata.yaml")
        return target

    def _schedule(self, scale: float) -> Iterator[tuple[int, Topic]]:
        events: list[tuple[int, int]] = []
        for number, topic in enumerate(self.sequence.topics):
            count = number_of(topic, self.sequence, scale)
            period_ns = round(1e9 / topic.hertz) if topic.hertz else 0
            events += [(START_NS + at * period_ns + number * 1000, number) for at in range(count)]
        for time_ns, number in sorted(events):
            yield time_ns, self.sequence.topics[number]

    def _message(self, topic: Topic, time_ns: int) -> Message:
        made = self.messages
        if image_bytes(topic):
            return self._image(topic, time_ns)
        if topic.kind == "CompressedImage":
            data = made.random.integers(0, 256, self.video_bytes, np.uint8)
            header = made.header(time_ns, "camera")
            return made.make(type_of(topic), header=header, format="h264", data=data)
        if topic.kind == "EncoderTicks":
            ticks = (time_ns - START_NS) // 10**6
            header = made.header(time_ns, "base_link")
            return made.make(
                type_of(topic), header=header, left_ticks=ticks, right_ticks=ticks, encoder_timestamp=time_ns
            )
        makers = {
            "BatteryState": made.battery,
            "CameraInfo": made.camera_info,
            "Imu": made.imu,
            "JointState": made.joints,
            "Odometry": made.odometry,
            "PointCloud2": made.cloud,
            "TFMessage": made.transforms,
        }
        return makers[topic.kind](time_ns)

    def _image(self, topic: Topic, time_ns: int) -> Message:
        """Return an image of which each line starts with random bytes and ends with zeros."""
        encoding, width, height = pixels_of(topic)
        step = width * BYTES[encoding]
        pixels = np.zeros((height, step), np.uint8)
        noise = round(step * self.random_share)
        pixels[:, :noise] = self.messages.random.integers(0, 256, (height, noise), np.uint8)
        # The message of r2b_hope has an empty header.
        hope = self.sequence.name == "r2b_hope"
        header = self.messages.header(0 if hope else time_ns, "" if hope else topic.name)
        return self.messages.make(
            type_of(topic),
            header=header,
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=step,
            data=pixels.ravel(),
        )

    def _rename(self, target: Path) -> None:
        """Give the file the name of the original, also in `metadata.yaml`."""
        wanted = Path(self.sequence.file).name
        (written,) = [path for path in target.iterdir() if path.name != "metadata.yaml"]
        metadata = target / "metadata.yaml"
        metadata.write_text(metadata.read_text().replace(written.name, wanted))
        written.rename(target / wanted)


def _as_version_5(file: Path, metadata: Path) -> None:
    """Remove what recordings of ROS 2 Humble do not contain, such as definitions."""
    with closing(sqlite3.connect(file)) as database:
        tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        for table in tables & {"message_definitions", "metadata", "schema"}:
            database.execute(f"DROP TABLE {table}")
        database.execute("ALTER TABLE topics DROP COLUMN type_description_hash")
        database.commit()
    document = yaml.safe_load(metadata.read_text())
    information = document["rosbag2_bagfile_information"]
    information["version"] = 5
    for key in ("custom_data", "ros_distro"):
        information.pop(key, None)
    for topic in information["topics_with_message_count"]:
        topic["topic_metadata"].pop("type_description_hash", None)
    metadata.write_text(yaml.safe_dump(document))


def measure(sequence: Sequence, data: Path, runs: int) -> tuple[Sample, float]:
    """Ingest a stand-in with its manifest; return the figures, and the stored size relative to the recording."""
    samples: list[Sample] = []
    recording = data / sequence.file
    with tempfile.TemporaryDirectory(dir=data) as name:
        store = Path(name) / "store"
        for _ in range(runs):
            shutil.rmtree(store, ignore_errors=True)
            environment = {**os.environ, "R2B": str(data.resolve()), "R2B_STORE": str(store)}
            command = [*INGEST, "run", MANIFESTS / f"{sequence.name}.yaml", "-q"]
            samples.append(run(command, environment))
        stored = sum(path.stat().st_size for path in store.rglob("*.parquet"))
    return typical(samples), stored / recording.stat().st_size


def hardware() -> str:
    """Return the model and the number of processors."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        match = re.search(r"model name\s*:\s*(.+)", cpuinfo.read_text())
        model = match[1] if match else model
    return f"{model}, {os.cpu_count()} cores"


def results(sequences: list[Sequence], data: Path, scale: float, runs: int, *, generate: bool) -> list[str]:
    """Generate and measure stand-ins, and return the rows of the table of results."""
    rows: list[str] = []
    for sequence in sequences:
        part = 1 if sequence.file_bytes < SMALL_FILE_BYTES else scale
        StandIn(sequence).write(data, part)
        size = (data / sequence.file).stat().st_size
        print(f"{sequence.name}: {size / 1e6:.1f} MB, expected {sequence.file_bytes * part / 1e6:.1f} MB")
        if not generate:
            sample, ratio = measure(sequence, data, runs)
            shutil.rmtree(data / sequence.name)
            saved = round((1 - ratio) * 100)
            rows.append(
                f"| {sequence.name} | {size / 1e6:.0f} MB | {saved} % | {sample.wall_s:.2f} s | {sample.cpu_s:.2f} s "
                f"| {sample.peak_bytes / 2**20:.0f} MiB | {sequence.note} |"
            )
    return rows


def known(value: str, evidence: Evidence) -> str:
    """Return a value with its evidence, unless it is known."""
    return value if evidence is Evidence.KNOWN else f"{value} ({evidence.value})"


def topic_tables() -> str:
    """Return the tables of the documentation: the sequences, and the topics of each kind of recording."""
    lines = ["| sequence | year | size | duration | content |", "|---|---|---:|---:|---|"]
    for sequence in SEQUENCES:
        size = known(f"{sequence.file_bytes / 1e6:,.0f} MB", sequence.size)
        seconds = known(f"{sequence.seconds:.1f} s", sequence.duration)
        lines.append(f"| {sequence.name} | {sequence.year} | {size} | {seconds} | {sequence.note} |")
    titles = {
        "r2b_galileo": "r2b_galileo",
        "r2b_galileo2": "r2b_galileo2",
        "r2b_robotarm": "r2b_robotarm",
        "r2b_whitetunnel": "r2b_whitetunnel",
        "r2b_cafe": "2023: r2b_cafe and the other sequences of the rig",
        "r2b_hope": "r2b_hope",
    }
    for name, title in titles.items():
        lines += ["", f"### {title}", "", "| topic | type | rate | messages |", "|---|---|---:|---:|"]
        for topic in BY_NAME[name].topics:
            rate = known(f"{topic.hertz:.0f} Hz" if topic.hertz else "once", topic.rate)
            count = "not known" if topic.count is None else f"{topic.count:,}"
            kind = f"`{type_of(topic)}`" + (f" {topic.kind}" if image_bytes(topic) else "")
            lines.append(f"| {known(f'`{topic.name}`', topic.evidence)} | {kind} | {rate} | {count} |")
    return "\n".join(lines)


def write_between(page: Path, marker: str, text: str) -> None:
    """Replace the part of a page between two markers."""
    start, end = f"<!-- {marker} -->", f"<!-- end of {marker} -->"
    before, rest = page.read_text(encoding="utf-8").split(start)
    page.write_text(f"{before}{start}\n\n{text}\n\n{end}{rest.split(end)[1]}", encoding="utf-8")


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequences", nargs="*", metavar="SEQUENCE", help="default: all")
    parser.add_argument("--scale", type=float, default=0.05, help="part of the duration (default: 0.05)")
    parser.add_argument("--runs", type=int, default=3, help="runs per sequence; 0 only writes the page")
    parser.add_argument("--data", type=Path, default=HERE / "data" / "r2b")
    parser.add_argument("--generate", action="store_true", help="write the recordings only")
    parser.add_argument("--page", type=Path, help="page whose tables are written")
    options = parser.parse_args()
    unknown = set(options.sequences) - BY_NAME.keys()
    if unknown:
        parser.error(f"unknown: {', '.join(sorted(unknown))}; there are {', '.join(BY_NAME)}")
    options.data.mkdir(parents=True, exist_ok=True)
    selected = [
        sequence for sequence in SEQUENCES if not options.sequences or sequence.name in options.sequences
    ]
    rows = []
    if options.runs:
        rows = results(selected, options.data, options.scale, options.runs, generate=options.generate)
    head = "| sequence | stand-in | saved | time | CPU | peak memory | content |"
    table = "\n".join([head, "|---|---:|---:|---:|---:|---:|---|", *rows])
    system = f"{hardware()}, {platform.system()}, Python {platform.python_version()}"
    command = " ".join(
        ["./dev bench r2b", *options.sequences, f"--scale {options.scale:g} --runs {options.runs}"]
    )
    text = f"{system}; scale {options.scale:g}, median of {options.runs}; `{command}`:\n\n{table}"
    if rows:
        print(text)
    if options.page:
        write_between(options.page, "sequences", topic_tables())
        if rows:
            write_between(options.page, "complete results" if options.scale == 1 else "results", text)


if __name__ == "__main__":
    main()
