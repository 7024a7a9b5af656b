"""Runs with several threads store the same bytes, count the same messages and fail in the same way as serial runs."""

from __future__ import annotations

import errno
import random
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosaico_ingest import RosbagInjector, ROSInjectionConfig
from mosaico_ingest.destinations.store import Store, session
from mosaico_ingest.destinations.store.segment import SegmentWriter
from mosaico_ingest.errors import IngestError, SinkError
from mosaico_ingest.pipeline.task import MemoryBudget
from mosaico_ingest.report.events import Event, Observer, TopicProgress, ignore_events
from mosaico_ingest.report.recording import Report
from mosaico_ingest.rosbag import blocks, recording
from mosaico_ingest.rosbag.blocks import Encoding
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.mcap import writer as mcap_writer
from mosaico_ingest.rosbag.serialization import Serializer

START_NS, STEP_NS = 1_700_000_000_000_000_000, 1_000_000
QUICKSTART = Path(__file__).parents[2] / "configs" / "quickstart" / "drive.mcap"
RESOLVER = TypeResolver("ros2_humble")
TOPICS = {
    "/speed": "std_msgs/msg/Float64",
    "/text": "std_msgs/msg/String",
    "/image": "sensor_msgs/msg/CompressedImage",
}
DEFINITIONS = {topic: RESOLVER.resolve(kind, None, ros_version=2) for topic, kind in TOPICS.items()}
SERIALIZERS = {topic: Serializer(DEFINITIONS[topic], Encoding.CDR) for topic in TOPICS}


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Divide small recordings into many reads and many row groups."""
    monkeypatch.setattr(recording, "_SMALL_RECORDING_BYTES", 0)
    monkeypatch.setattr(blocks, "FIRST_GROUP_BYTES", 2048)
    monkeypatch.setattr(blocks, "MAX_GROUP_LENGTH", 4)
    for name in ("_FIRST_GROUP_BYTES", "_GROUP_BYTES", "_BIG_GROUP_BYTES"):
        monkeypatch.setattr(session, name, 4096)
    monkeypatch.setattr(mcap_writer, "_CHUNK_BYTES", 1024)
    limit_memory(monkeypatch, 16 << 10)
    delay(monkeypatch, recording.Recording, "_load")
    delay(monkeypatch, session.StoreTopic, "_write_later")


def delay(monkeypatch: pytest.MonkeyPatch, owner: type, name: str) -> None:
    """Delay the calls of a method by different times, so that threads overtake each other."""
    method, times = getattr(owner, name), random.Random(0)  # noqa: S311 - test data

    def delayed(*arguments: object) -> object:
        if threading.current_thread() is not threading.main_thread():
            time.sleep(times.random() * 0.003)
        return method(*arguments)

    monkeypatch.setattr(owner, name, delayed)


def limit_memory(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    """Limit the reader and the sink to `size` bytes each, which determines the sizes of batches and row groups."""
    monkeypatch.setattr(MemoryBudget, "read_bytes", size)
    monkeypatch.setattr(MemoryBudget, "sink_bytes", size)


def payload(topic: str, number: int) -> bytes:
    if topic == "/speed":
        return SERIALIZERS[topic].from_dict({"data": float(number)})
    if topic == "/text":
        return SERIALIZERS[topic].from_dict({"data": f"text {number}"})
    header = {"stamp": {"sec": number, "nanosec": 0}, "frame_id": "camera"}
    image = random.Random(number).randbytes(number * 37 % 5000)  # noqa: S311 - test data
    return SERIALIZERS[topic].from_dict({"header": header, "format": "jpeg", "data": image})


Message = tuple[str, int, bool]
"""The topic, the time step, and whether the message is truncated."""


def write_recording(path: Path, messages: Sequence[Message]) -> Path:
    writer = mcap_writer.McapWriter(path)
    channels = {topic: writer.add_connection(topic, DEFINITIONS[topic]) for topic in TOPICS}
    for number, (topic, step, is_cut) in enumerate(messages):
        content = payload(topic, number)
        writer.write(channels[topic], START_NS + step * STEP_NS, content[:-1] if is_cut else content)
    writer.finish()
    return path


def regular(count: int) -> list[Message]:
    return [(tuple(TOPICS)[number % 3], number, False) for number in range(count)]


def run(
    path: Path,
    store: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    processors: int,
    observe: Observer = ignore_events,
) -> Report:
    before = threading.active_count()
    with monkeypatch.context() as patched:
        patched.setattr(pa, "cpu_count", lambda: processors)
        try:
            return RosbagInjector(ROSInjectionConfig(path, "drive", store=store), observe=observe).run()
        finally:
            assert threading.active_count() == before


def stored_files(store: Path) -> dict[str, list[bytes]]:
    """Return the content of the segments of each topic, in the order of their numbers."""
    files: dict[str, list[bytes]] = {}
    for path in sorted(store.rglob("*.parquet")):
        files.setdefault(str(path.parent.relative_to(store)), []).append(path.read_bytes())
    return files


def accounting(report: Report) -> tuple[object, ...]:
    return (
        report.status,
        report.exit_code,
        report.topics,
        report.unreadable_ranges,
        report.findings,
        report.totals,
    )


def outcome(path: Path, store: Path, monkeypatch: pytest.MonkeyPatch, processors: int) -> tuple[Any, ...]:
    try:
        report = run(path, store, monkeypatch, processors=processors)
    except IngestError as error:
        return type(error), str(error), stored_files(store)
    return *accounting(report), stored_files(store)


@pytest.mark.parametrize("processors", [2, 3, 8])
def test_parallel_run_of_recording_equals_serial_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, processors: int
) -> None:
    serial = run(QUICKSTART, tmp_path / "serial", monkeypatch, processors=1)
    parallel = run(QUICKSTART, tmp_path / "parallel", monkeypatch, processors=processors)
    assert accounting(parallel) == accounting(serial)
    files = stored_files(tmp_path / "serial")
    assert len(files) == len(serial.topics)
    assert stored_files(tmp_path / "parallel") == files


@settings(max_examples=15, deadline=None)  # a run is as slow as the machine's disk
@given(
    messages=st.lists(
        st.tuples(st.sampled_from(tuple(TOPICS)), st.integers(0, 400), st.sampled_from([False] * 9 + [True])),
        min_size=1,
        max_size=150,
    ),
    damage=st.none() | st.floats(0.05, 0.9),
    processors=st.integers(2, 6),
    memory_bytes=st.integers(16 << 10, 128 << 10),
)
def test_parallel_run_of_generated_recording_equals_serial_run(
    messages: list[Message], damage: float | None, processors: int, memory_bytes: int
) -> None:
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as monkeypatch:
        limit_memory(monkeypatch, memory_bytes)
        path = write_recording(Path(folder, "drive.mcap"), messages)
        if damage is not None:
            content = bytearray(path.read_bytes())
            content[int(len(content) * damage)] ^= 0xFF
            path.write_bytes(content)
        serial = outcome(path, Path(folder, "serial"), monkeypatch, 1)
        assert outcome(path, Path(folder, "parallel"), monkeypatch, processors) == serial


@pytest.mark.parametrize("processors", [1, 2, 4])
def test_write_error_in_any_thread_discards_session_and_ends_threads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, processors: int
) -> None:
    groups = 0
    append = SegmentWriter.append

    def fail_later(self: SegmentWriter, rows: pa.Table) -> None:
        nonlocal groups
        groups += 1
        if groups > 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        append(self, rows)

    monkeypatch.setattr(SegmentWriter, "append", fail_later)
    path = write_recording(tmp_path / "drive.mcap", regular(300))
    with pytest.raises(SinkError, match="No space left"):
        run(path, tmp_path / "store", monkeypatch, processors=processors)
    assert Store.open(tmp_path / "store").names() == ()
    assert stored_files(tmp_path / "store") == {}
    assert groups <= 3 + processors, "the run went on after the error"


@pytest.mark.parametrize("processors", [1, 2, 4])
def test_interrupt_discards_session_and_ends_threads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, processors: int
) -> None:
    def interrupt(event: Event) -> None:
        if isinstance(event, TopicProgress) and event.read:
            raise KeyboardInterrupt

    path = write_recording(tmp_path / "drive.mcap", regular(300))
    with pytest.raises(IngestError) as raised:
        run(path, tmp_path / "store", monkeypatch, processors=processors, observe=interrupt)
    assert raised.value.exit_code == 130
    assert Store.open(tmp_path / "store").names() == ()
    assert stored_files(tmp_path / "store") == {}


@pytest.mark.parametrize("processors", [2, 4])
def test_error_of_a_read_keeps_the_same_rows_as_a_serial_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, processors: int
) -> None:
    original = recording.copy_if_small

    def fail(block: blocks.MessageBlock) -> blocks.MessageBlock:
        if int(block.log_times.max()) >= START_NS + 200 * STEP_NS:
            raise MemoryError("here")
        return original(block)

    monkeypatch.setattr(recording, "copy_if_small", fail)
    path = write_recording(tmp_path / "drive.mcap", regular(300))
    serial = outcome(path, tmp_path / "serial", monkeypatch, 1)
    assert serial[2]["segments/drive/image"]
    assert outcome(path, tmp_path / "parallel", monkeypatch, processors) == serial
    assert "unexpected MemoryError: here" in str(serial[1])
