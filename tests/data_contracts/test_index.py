"""Contracts of log times: the index of a recording gives the same results as its messages."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from made_recordings import define, record

from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.pipeline.contract_check import check_contract, needs_times_only
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.recording import Recording, open_recording

START = 1_700_000_000 * 10**9
ROS2 = define("std_msgs/msg/Int64", "int64 data\n")
ROS1 = define("std_msgs/Int64", "int64 data\n", version=1)
TOPIC = {
    "rate": {"min": "2 Hz"},
    "sliding_rate": {"window": "1s", "max": "5 Hz"},
    "gap": {"max": "1s"},
    "gaps": {"over": "2 periods", "max_share": "5%"},
    "messages": {"min": 3},
    "coverage": {"min": "80%", "gap": "1s"},
    "start": {"within": "1s"},
    "end": {"within": "1s", "of": "/b"},
}
EXPECT = {"recording": {"duration": {"min": "2s"}}, "required": ["/a"], "topics": {"*": TOPIC}}
MESSAGES = st.lists(st.tuples(st.sampled_from(["/a", "/b"]), st.integers(0, 50)), min_size=1, max_size=40)


def results(path: Path) -> Any:
    job = ROSInjectionConfig(file_path=path, sequence_name="x", manifest={"expect": EXPECT}).job
    assert needs_times_only(job)
    return check_contract(job)


def results_of_messages(path: Path) -> Any:
    with patch.object(Recording, "index_times", lambda *_, **__: None):
        return results(path)


def index_times(path: Path) -> Any:
    with open_recording(path, resolve=TypeResolver()) as recording:
        return recording.index_times([connection.id for connection in recording.connections])


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(["mcap", "bag"]), MESSAGES)
@example("db3", [("/a", 3), ("/b", 1), ("/a", 1), ("/a", 40)])
def test_check_of_index_equals_check_of_messages(
    tmp_path: Path, suffix: str, messages: list[tuple[str, int]]
) -> None:
    definition = ROS1 if suffix == "bag" else ROS2
    path = tmp_path / f"a.{suffix}"
    path.unlink(missing_ok=True)
    record(path, [(topic, definition, START + step * 10**8, {"data": 1}) for topic, step in messages])
    assert index_times(path) is not None
    assert results(path) == results_of_messages(path)


def message_indexes(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield the start and the end of the entries of each message index of an MCAP file."""
    position = 8  # after the magic bytes
    while position + 9 <= len(data):
        op, length = struct.unpack_from("<BQ", data, position)
        if op == 7:
            yield position + 9 + 6, position + 9 + length
        position += 9 + length


@pytest.mark.parametrize("moved_ns", [-(10**9), 3600 * 10**9])
def test_check_of_index_with_time_outside_chunk_reads_messages(tmp_path: Path, moved_ns: int) -> None:
    steps = (0, 1, 2, 3)
    path = record(tmp_path / "a.mcap", [("/a", ROS2, START + step * 10**8, {"data": 1}) for step in steps])
    expected = results(path)
    data = bytearray(path.read_bytes())
    ((start, _),) = message_indexes(bytes(data))
    data[start : start + 8] = struct.pack("<Q", START + moved_ns)
    path.write_bytes(data)
    assert index_times(path) is None
    assert results(path) == expected


def test_check_of_index_with_fewer_times_than_messages_reads_messages(tmp_path: Path) -> None:
    steps = (0, 1, 2, 3)
    path = record(tmp_path / "a.mcap", [("/a", ROS2, START + step * 10**8, {"data": 1}) for step in steps])
    data = bytearray(path.read_bytes())
    ((start, end),) = message_indexes(bytes(data))
    data[start - 4 : start] = struct.pack("<I", end - start - 16)
    path.write_bytes(data)
    assert index_times(path) is None
