"""Written recordings are complete and readable."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pytest
from made_recordings import define

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.recording import open_recording
from mosaico_ingest.rosbag.rosbags_library import SqliteWriter, open_writer

TEXT = define("std_msgs/msg/String", "string data\n")
BLOB = define("acme_msgs/msg/Blob", "uint8[] data\n")


def write_many(path: Path, *, payloads: int, size: int) -> None:
    with open_writer(path) as writer:
        first = writer.add_connection("/a", BLOB)
        for number in range(payloads):
            writer.write(first, number * 10, number.to_bytes(4, "little") + bytes(size))
        second = writer.add_connection("/b", TEXT)
        writer.write(second, 5, b"late")


@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
def test_writer_many_chunks_are_indexed(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"out{suffix}"
    write_many(path, payloads=90, size=100_000)
    with open_recording([path], resolve=TypeResolver()) as recording:
        counts = {channel.topic: channel.count for channel in recording.connections}
        assert counts == {"/a": 90, "/b": 1}
        assert (recording.start_ns, recording.end_ns) == (0, 890)
        actual = {channel.topic: channel.id for channel in recording.connections}
        batches = list(recording.message_blocks((actual["/a"],), start_ns=300, end_ns=500))
        times = np.concatenate([batch.log_times for batch in batches])
        assert times.tolist() == list(range(300, 500, 10))
        assert batches[0].payload(0)[:4] == (30).to_bytes(4, "little")
        late = next(iter(recording.message_blocks((actual["/b"],))))
        assert late.payload(0) == b"late"
        assert not recording.unreadable


def test_writer_two_definitions_of_a_type_need_mcap(tmp_path: Path) -> None:
    other = define("std_msgs/msg/String", "string data\nint8 more\n")
    with open_writer(tmp_path / "out.mcap") as writer:
        for topic, definition in (("/a", TEXT), ("/b", other), ("/c", TEXT)):
            writer.write(writer.add_connection(topic, definition), 0, b"\0\1\0\0")
    with open_recording([tmp_path / "out.mcap"], resolve=TypeResolver()) as recording:
        texts = {c.topic: c.definition.text for c in recording.connections if c.definition}
    assert texts == {"/a": TEXT.text, "/b": other.text, "/c": TEXT.text}
    with pytest.raises(BagError, match="another definition"), open_writer(tmp_path / "out.db3") as writer:
        writer.add_connection("/a", TEXT)
        writer.add_connection("/b", other)
    assert [path.name for path in tmp_path.iterdir()] == ["out.mcap"]


def test_writer_exception_keeps_existing_file(tmp_path: Path) -> None:
    for suffix in (".mcap", ".db3", ".bag"):
        path = tmp_path / f"out{suffix}"
        path.write_bytes(b"mine")
        with pytest.raises(KeyboardInterrupt), open_writer(path, replace=True):
            raise KeyboardInterrupt
        assert path.read_bytes() == b"mine"
    assert len(list(tmp_path.iterdir())) == 3


def test_writer_unwritable_database_raises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr(SqliteWriter, "write", full)
    with pytest.raises(BagError, match=r"out.db3: cannot be written: database or disk is full"):
        write_many(tmp_path / "out.db3", payloads=1, size=1)
    assert list(tmp_path.iterdir()) == []


def test_writer_recording_without_messages_is_readable(tmp_path: Path) -> None:
    with open_writer(tmp_path / "out.mcap") as writer:
        writer.add_connection("/a", TEXT)
    with open_recording([tmp_path / "out.mcap"], resolve=TypeResolver()) as recording:
        assert [channel.count for channel in recording.connections] == [0]
