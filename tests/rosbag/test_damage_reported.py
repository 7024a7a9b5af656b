"""Damage that hides topics, messages or splits is reported as such."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import pytest
import zstandard

from mosaico_ingest.cli.app import main
from mosaico_ingest.errors import BagError, NothingMatched
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.loader import ROSLoader
from mosaico_ingest.rosbag.recording import no_topics_error, open_recording


def test_loader_truncated_mcap_without_topics_names_the_damage(tmp_path: Path, recordings: Any) -> None:
    path = recordings.mcap(tmp_path / "cut.mcap", recordings.sent(100), chunk_messages=100)
    path.write_bytes(path.read_bytes()[:120])
    with pytest.raises(BagError, match="no topic can be read: the chunk is truncated"):
        ROSLoader(path)


def test_loader_truncated_bag_without_topics_names_the_damage(tmp_path: Path, recordings: Any) -> None:
    path = recordings.ros1(tmp_path / "cut.bag", recordings.sent(100, cdr=False), compression="lz4")
    path.write_bytes(path.read_bytes()[: 4117 + 150])
    with pytest.raises(BagError, match="no topic can be read: "):
        ROSLoader(path)


def test_no_topics_error_intact_empty_recording_is_nothing_matched(tmp_path: Path, recordings: Any) -> None:
    path = recordings.mcap(tmp_path / "empty.mcap", [])
    with open_recording(path, resolve=TypeResolver()) as recording:
        assert isinstance(no_topics_error(recording), NothingMatched)


@pytest.mark.parametrize("position", [4, 9])
def test_open_damaged_zstd_file_is_not_called_empty(tmp_path: Path, recordings: Any, position: int) -> None:
    path = recordings.mcap(tmp_path / "a.mcap", recordings.sent(50))
    content = bytearray(zstandard.compress(path.read_bytes()))
    content[position : position + 8] = b"\xff" * 8
    compressed = tmp_path / "a.mcap.zstd"
    compressed.write_bytes(content)
    with pytest.raises(BagError) as caught:
        open_recording(compressed, resolve=TypeResolver())
    assert "zstd" in caught.value.what
    assert "empty" not in caught.value.what
    assert "remove" not in (caught.value.hint or "")


def test_recording_split_truncated_before_its_topics_is_unreadable(tmp_path: Path, recordings: Any) -> None:
    folder = tmp_path / "split"
    folder.mkdir()
    messages = recordings.sent(200)
    recordings.mcap(folder / "a_0.mcap", messages[:100])
    second = recordings.mcap(folder / "a_1.mcap", messages[100:], chunk_messages=100)
    second.write_bytes(second.read_bytes()[:120])
    with open_recording(folder, resolve=recordings.blind) as recording:
        assert len(recordings.received(recording)) == 100
        assert [(item.file, item.count) for item in recording.unreadable if item.count != 0] == [
            (str(second), None)
        ]


def test_discover_truncated_list_of_splits_reads_unlisted_splits(tmp_path: Path, recordings: Any) -> None:
    folder = tmp_path / "split"
    folder.mkdir()
    messages = recordings.sent(90)
    for number in range(3):
        recordings.mcap(folder / f"a_{number}.mcap", messages[30 * number : 30 * (number + 1)])
    recordings.mcap(folder / "other.mcap", messages)
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 5\n  message_count: 90\n  relative_file_paths:\n  - a_0.mcap\n"
    )
    with open_recording(folder, resolve=recordings.blind) as recording:
        assert [file.name for file in recording.files] == ["a_0.mcap", "a_1.mcap", "a_2.mcap"]
        assert len(recordings.received(recording)) == 90
        assert sum(finding.rule == "metadata-differs" for finding in recording.findings) >= 2


def _chunk(size: int, data: bytes, compression: str) -> bytes:
    """Return an MCAP file with one chunk that declares `size` bytes."""
    name = struct.pack("<I", len(compression)) + compression.encode()
    head = struct.pack("<QQQI", 1, 2, size, 0) + name + struct.pack("<Q", len(data))
    chunk = struct.pack("<BQ", 6, len(head) + len(data)) + head + data
    header = struct.pack("<BQII", 1, 8, 0, 0)
    return b"\x89MCAP0\r\n" + header + chunk + struct.pack("<BQI", 15, 4, 0)


@pytest.mark.parametrize("announced", [1 << 30, 1 << 20])
def test_mcap_chunk_beyond_limit_is_unreadable_without_decompressing(tmp_path: Path, announced: int) -> None:
    path = tmp_path / "bomb.mcap"
    path.write_bytes(_chunk(announced, zstandard.compress(bytes(1 << 20)), "zstd"))
    with open_recording(path, resolve=TypeResolver(), max_chunk_bytes=1 << 19) as recording:
        reasons = [item.reason for item in recording.unreadable]
        expected = f"{announced} bytes announced, more than the {1 << 19} bytes of bag.max_chunk_size"
        assert any(expected in reason for reason in reasons)
        assert sum(map(len, recording.message_blocks())) == 0


def test_mcap_many_chunks_beyond_buffer_limit_are_read_individually(
    tmp_path: Path, recordings: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages = recordings.sent(300)
    path = recordings.mcap(tmp_path / "a.mcap", messages, chunk_messages=10)
    monkeypatch.setattr("mosaico_ingest.rosbag.compression._MAX_BUFFER_BYTES", 1)
    with open_recording(path, resolve=recordings.blind) as recording:
        assert recordings.received(recording) == sorted(messages)


def test_run_all_messages_unreadable_names_the_damage(
    tmp_path: Path, recordings: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recordings.mcap(tmp_path / "a.mcap", recordings.sent(40), chunk_messages=40)
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 1
    path.write_bytes(content)
    arguments = ["bag", str(path), "--name", "drive", "--store", str(tmp_path / "store")]
    with pytest.raises(SystemExit) as ended:
        main([*arguments, "--ros-distro", "ros2_humble"])
    assert ended.value.code == 1
    assert "no message can be read: broken chunk" in capsys.readouterr().err
