"""Recordings return the recorded messages for every container, compression and selection."""

from __future__ import annotations

import os
import sqlite3
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from rosbags import rosbag1, rosbag2

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.blocks import Encoding
from mosaico_ingest.rosbag.recording import open_recording

MCAP_FORMS = {
    "zstd": {},
    "lz4": {"compression": "lz4"},
    "plain": {"compression": ""},
    "no message index": {"indexed": False},
    "no summary": {"summary": False},
    "no summary, no index": {"summary": False, "indexed": False},
    "no chunks": {"chunked": False},
    "no chunks, no summary": {"chunked": False, "summary": False},
}


@pytest.mark.parametrize("form", MCAP_FORMS)
@pytest.mark.parametrize("big", [False, True], ids=["small", "big"])
def test_mcap_any_structure_yields_every_message(
    tmp_path: Path, recordings: Any, form: str, *, big: bool
) -> None:
    messages = recordings.sent(big=big)
    path = recordings.mcap(tmp_path / "a.mcap", messages, **MCAP_FORMS[form])
    with open_recording(path, resolve=recordings.blind) as recording:
        assert recording.container == "mcap"
        assert recordings.received(recording) == sorted(messages)
        assert recording.unreadable == ()
        assert recording.message_count in {300, None}
        assert (recording.start_ns, recording.end_ns) == (messages[0].time_ns, messages[-1].time_ns)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("compression", ["none", "file", "message", "storage"])
def test_rosbag2_directory_yields_messages_of_rosbags(
    tmp_path: Path, recordings: Any, storage: str, compression: str
) -> None:
    if storage == "sqlite3" and compression == "storage":
        pytest.skip("SQLite has no compression of its own")
    path = recordings.rosbag2(
        tmp_path / "b", recordings.sent(big=True), storage=storage, compression=compression
    )
    with rosbag2.Reader(path) as reader:
        expected = sorted(
            recordings.Sent(connection.topic, connection.msgtype, time, bytes(data))
            for connection, time, data in reader.messages()
        )
    with open_recording(path, resolve=recordings.blind) as recording:
        assert recording.container == storage
        assert recordings.received(recording) == expected
        assert recording.message_count == len(expected)
        assert recording.unreadable == ()
        assert not [finding for finding in recording.findings if finding.rule != "container-note"]


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_ros1_bag_yields_messages_of_rosbags(tmp_path: Path, recordings: Any, compression: str) -> None:
    path = recordings.ros1(tmp_path / "c.bag", recordings.sent(big=True, cdr=False), compression=compression)
    with rosbag1.Reader(path) as reader:
        expected = sorted(
            recordings.Sent(connection.topic, connection.msgtype, time, bytes(data))
            for connection, time, data in reader.messages()
        )
    with open_recording(path, resolve=recordings.blind) as recording:
        assert recording.container == "ros1"
        assert recordings.received(recording) == expected
        assert recording.unreadable == ()
        assert {channel.encoding for channel in recording.connections} == {Encoding.ROS1}
        assert sum(channel.count or 0 for channel in recording.connections) == len(expected)


@pytest.mark.parametrize("kind", ["mcap", "sqlite3", "ros1"])
def test_message_blocks_selects_connections_and_times(tmp_path: Path, recordings: Any, kind: str) -> None:
    messages = recordings.sent()
    path = tmp_path / "d"
    if kind == "ros1":
        recordings.ros1(path, messages)
    else:
        recordings.rosbag2(path, messages, storage=kind)
    start, end = messages[60].time_ns, messages[200].time_ns
    with open_recording(path, resolve=recordings.blind) as recording:
        ids = [channel.id for channel in recording.connections if channel.topic in {"/imu", "/chatter"}]
        actual = recordings.received(recording, connection_ids=ids, start_ns=start, end_ns=end)
        assert recordings.received(recording, connection_ids=[]) == []
    wanted = [m for m in messages if m.topic in {"/imu", "/chatter"} and start <= m.time_ns < end]
    assert actual == sorted(wanted)


def test_splits_are_merged_by_time(tmp_path: Path, recordings: Any) -> None:
    messages = recordings.sent()
    paths = [recordings.mcap(tmp_path / f"p_{n}.mcap", messages[n::3]) for n in range(3)]
    with open_recording(paths, resolve=recordings.blind) as recording:
        assert recordings.received(recording) == sorted(messages)
        assert recording.files == tuple(paths)
        assert len(recording.connections) == 4
        assert recording.message_count == len(messages)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_message_blocks_little_memory_yields_every_message(
    tmp_path: Path, recordings: Any, storage: str
) -> None:
    messages = recordings.sent(big=True)
    recordings.rosbag2(tmp_path / "e", messages, storage=storage)
    with open_recording(tmp_path / "e", resolve=recordings.blind) as recording:
        batches = list(recording.message_blocks(max_rows=20, memory_bytes=1 << 20))
    assert max(len(batch) for batch in batches) <= 20
    assert sum(len(batch) for batch in batches) == len(messages)


def test_overlapping_chunks_are_sorted_by_time(tmp_path: Path, recordings: Any) -> None:
    messages = recordings.sent()
    shuffled = [message for n in range(7) for message in messages[n::7]]
    path = recordings.mcap(tmp_path / "f.mcap", shuffled, chunk_messages=17)
    with open_recording(path, resolve=recordings.blind) as recording:
        assert recordings.received(recording) == sorted(messages)
        assert recordings.received(recording, max_rows=5) == sorted(messages)


def test_small_messages_are_coalesced_and_large_ones_not_copied(tmp_path: Path, recordings: Any) -> None:
    messages = recordings.sent(2000, big=True)
    path = recordings.mcap(tmp_path / "g.mcap", messages, chunk_messages=100)
    with open_recording(path, resolve=recordings.blind) as recording:
        batches = list(recording.message_blocks())
    small = [batch for batch in batches if recording.connections[batch.connection].topic == "/imu"]
    assert len(small) == 1
    assert len(small[0].data) == int(small[0].lengths.sum())
    image = next(batch for batch in batches if recording.connections[batch.connection].topic == "/image")
    assert len(image.data) > int(image.lengths.sum())


def test_topic_with_two_types_is_two_connections_and_a_finding(tmp_path: Path, recordings: Any) -> None:
    one = [
        recordings.Sent("/t", "std_msgs/msg/String", recordings.START_NS + n, b"\0\1\0\0") for n in range(3)
    ]
    two = [message._replace(msgtype="std_msgs/msg/Empty") for message in one]
    paths = [recordings.mcap(tmp_path / "1.mcap", one), recordings.mcap(tmp_path / "2.mcap", two)]
    with open_recording(paths, resolve=recordings.easy) as recording:
        assert [channel.msgtype for channel in recording.connections] == [
            "std_msgs/msg/String",
            "std_msgs/msg/Empty",
        ]
        assert [finding.rule for finding in recording.findings] == ["mixed-types"]


def test_connection_without_definition_has_a_problem(tmp_path: Path, recordings: Any) -> None:
    path = recordings.mcap(tmp_path / "h.mcap", recordings.sent(10))
    with open_recording(path, resolve=recordings.blind) as recording:
        assert all(channel.definition is None for channel in recording.connections)
        assert all("is not known" in str(channel.problem) for channel in recording.connections)


def test_other_encodings_are_listed_and_readable(tmp_path: Path, recordings: Any) -> None:
    path = recordings.mcap(tmp_path / "i.mcap", recordings.sent(10), encoding="cbor")
    with open_recording(path, resolve=recordings.easy) as recording:
        assert {channel.encoding for channel in recording.connections} == {Encoding.OTHER}
        assert {finding.rule for finding in recording.findings} == {"skipped-encoding"}
        assert len(recordings.received(recording)) == 10


@pytest.mark.parametrize(("processors", "readers"), [(1, 0), (2, 1), (3, 2), (8, 3)])
def test_message_blocks_use_a_reader_per_spare_cpu_and_leave_no_thread(
    tmp_path: Path, recordings: Any, monkeypatch: pytest.MonkeyPatch, processors: int, readers: int
) -> None:
    monkeypatch.setattr(pa, "cpu_count", lambda: processors)
    path = recordings.mcap(
        tmp_path / "j.mcap", recordings.sent(1000, big=True), chunk_messages=5, compression=""
    )
    before = threading.active_count()
    recording = open_recording(path, resolve=recordings.blind)
    running = recording.message_blocks()
    next(running)
    names = [thread.name for thread in threading.enumerate()]
    started = sum(name.startswith("mosaico-read") for name in names)
    assert started <= readers
    assert bool(started) is bool(readers)
    recording.close()
    assert threading.active_count() == before
    recording.close()


@pytest.mark.parametrize("processors", [1, 2, 4])
def test_file_truncated_during_read_loses_only_its_end(
    tmp_path: Path, recordings: Any, monkeypatch: pytest.MonkeyPatch, processors: int
) -> None:
    monkeypatch.setattr(pa, "cpu_count", lambda: processors)
    messages = recordings.sent(1000, big=True)
    path = recordings.mcap(tmp_path / "k.mcap", messages, chunk_messages=20, compression="")
    with open_recording(path, resolve=recordings.blind) as recording:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        actual = recordings.received(recording)
        assert actual
        assert set(actual) < set(messages)
        assert any("truncated" in loss.reason for loss in recording.unreadable)


def test_splits_of_different_formats_raise(tmp_path: Path, recordings: Any) -> None:
    paths = [
        recordings.mcap(tmp_path / "l.mcap", recordings.sent(5)),
        recordings.ros1(tmp_path / "l.bag", recordings.sent(5, cdr=False)),
    ]
    with pytest.raises(BagError, match="different formats: mcap, ros1"):
        open_recording(paths, resolve=recordings.blind)


def test_offsets_point_at_records(tmp_path: Path, recordings: Any) -> None:
    path = recordings.mcap(tmp_path / "m.mcap", recordings.sent(), chunked=False)
    content = path.read_bytes()
    with open_recording(path, resolve=recordings.blind) as recording:
        for batch in recording.message_blocks():
            assert all(content[offset] == 5 for offset in batch.offsets.tolist())
            assert batch.offsets.dtype == np.int64


@pytest.mark.skipif(not hasattr(os, "pread"), reason="counts calls of os.pread")
def test_time_range_reads_only_its_share_of_the_file(
    tmp_path: Path, recordings: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages = recordings.sent(4000, big=True)
    path = recordings.mcap(tmp_path / "n.mcap", messages, chunk_messages=20, compression="")
    read: list[int] = []
    pread, preadv = os.pread, os.preadv
    monkeypatch.setattr(os, "pread", lambda fd, size, at: read.append(size) or pread(fd, size, at))
    monkeypatch.setattr(
        os, "preadv", lambda fd, into, at: read.extend(map(len, into)) or preadv(fd, into, at)
    )
    with open_recording(path, resolve=recordings.blind) as recording:
        start, end = messages[2000].time_ns, messages[2040].time_ns
        assert len(recordings.received(recording, start_ns=start, end_ns=end)) == 40
    assert path.stat().st_size // 200 < sum(read) < path.stat().st_size // 30


@pytest.mark.parametrize("is_read", [True, False])
def test_close_removes_decompressed_copy(
    tmp_path: Path, recordings: Any, monkeypatch: pytest.MonkeyPatch, *, is_read: bool
) -> None:
    folder = recordings.rosbag2(tmp_path / "o", recordings.sent(20), storage="sqlite3", compression="file")
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    recording = open_recording(folder, resolve=recordings.blind)
    assert list((tmp_path / "temporary").iterdir())
    if is_read:
        recordings.received(recording)
    recording.close()
    assert not list((tmp_path / "temporary").iterdir())


def test_transient_local_topic_is_latched(tmp_path: Path, recordings: Any) -> None:
    folder = recordings.rosbag2(tmp_path / "p", recordings.sent(20), storage="sqlite3")
    with sqlite3.connect(next(folder.glob("*.db3"))) as writer:
        writer.execute("UPDATE topics SET offered_qos_profiles = '- durability: 1' WHERE name = '/imu'")
    writer.close()
    with open_recording(folder, resolve=recordings.blind) as recording:
        assert {channel.topic for channel in recording.connections if channel.latched} == {"/imu"}
