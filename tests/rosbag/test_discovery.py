"""Discovery of a recording's files by content, directory and metadata.yaml; missing files are reported."""

from __future__ import annotations

import shutil
import sqlite3
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import yaml
import zstandard

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.discovery import discover, may_have_custom_data, parse_metadata
from mosaico_ingest.rosbag.recording import open_recording

BOMB = "\n".join(
    [
        "a: &a0 [x]",
        *(f"b{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 30)),
        "rosbag2_bagfile_information: {relative_file_paths: [*a29]}",
    ]
)


@pytest.fixture
def split(tmp_path: Path, recordings: Any) -> Path:
    """A recording with three splits and its metadata."""
    folder = tmp_path / "split"
    folder.mkdir()
    messages = recordings.sent(90)
    names = [f"part_{number}.mcap" for number in (8, 9, 10)]
    for number, name in enumerate(names):
        recordings.mcap(folder / name, messages[30 * number : 30 * number + 30])
    topics = sorted({(message.topic, message.msgtype) for message in messages})
    info = {
        "version": 5,
        "relative_file_paths": names,
        "message_count": 90,
        "topics_with_message_count": [
            {
                "topic_metadata": {"name": topic, "type": msgtype, "serialization_format": "cdr"},
                "message_count": sum(message.topic == topic for message in messages),
            }
            for topic, msgtype in topics
        ],
    }
    write_metadata(folder, info)
    return folder


def write_metadata(folder: Path, info: dict[str, Any]) -> None:
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": info}))


def read_info(folder: Path) -> dict[str, Any]:
    return yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]


def rules(path: Path, recordings: Any) -> list[str]:
    with open_recording(path, resolve=recordings.blind) as recording:
        return [finding.rule for finding in recording.findings]


def test_discover_directory_equals_its_metadata_file(split: Path, recordings: Any) -> None:
    names = [f"part_{number}.mcap" for number in (8, 9, 10)]
    assert [file.name for file in discover([split]).files] == names
    assert [file.name for file in discover([split / "metadata.yaml"]).files] == names
    (split / "metadata.yaml").unlink()
    assert [file.name for file in discover([split]).files] == names
    with open_recording(split, resolve=recordings.blind) as recording:
        assert recordings.received(recording) == sorted(recordings.sent(90))
        assert recording.findings == ()


def test_discover_missing_split_is_finding_and_unreadable_range(split: Path, recordings: Any) -> None:
    (split / "part_9.mcap").unlink()
    with open_recording(split, resolve=recordings.blind) as recording:
        assert len(recordings.received(recording)) == 60
        assert "missing-split" in [finding.rule for finding in recording.findings]
        assert any("part_9.mcap" in finding.message for finding in recording.findings)
        assert [(Path(loss.file).name, loss.count) for loss in recording.unreadable] == [
            ("part_9.mcap", None)
        ]


def test_discover_single_split_reports_other_splits(split: Path, recordings: Any) -> None:
    assert rules(split / "part_9.mcap", recordings) == ["single-split"]


def test_open_metadata_differing_from_files_is_finding(split: Path, recordings: Any) -> None:
    info = read_info(split)
    for entry in info["topics_with_message_count"]:
        entry["topic_metadata"] |= {"type": "std_msgs/msg/Bool"}
        entry["message_count"] -= 1
    info["topics_with_message_count"].pop()
    write_metadata(split, info)
    with open_recording(split, resolve=recordings.blind) as recording:
        assert len(recordings.received(recording)) == 90
        assert recording.unreadable == ()
        messages = [finding.message for finding in recording.findings if finding.rule == "metadata-differs"]
    assert sum("std_msgs/msg/Bool in the metadata" in message for message in messages) == 3
    assert sum("is not in the metadata" in message for message in messages) == 1
    assert sum("messages in the metadata" in message for message in messages) == 3


def test_open_recording_with_fewer_messages_than_metadata_reports_missing_messages(
    split: Path, recordings: Any
) -> None:
    info = read_info(split)
    first = info["topics_with_message_count"][0]
    first["message_count"] += 3
    other = {"topic_metadata": {**first["topic_metadata"], "name": "/other"}, "message_count": 5}
    info["topics_with_message_count"].append(other)
    write_metadata(split, info)
    with open_recording(split, resolve=recordings.blind) as recording:
        assert len(recordings.received(recording)) == 90
        topics = {connection.id: connection.topic for connection in recording.connections}
        missing = {topics.get(item.connection, "/other"): item.count for item in recording.unreadable}
        assert missing == {first["topic_metadata"]["name"]: 3, "/other": 5}
        assert recording.message_count == 98
        assert sum(finding.rule == "unreadable-range" for finding in recording.findings) == 2


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_recording_cut_at_message_reports_messages_of_metadata_as_missing(
    storage: str, tmp_path: Path, recordings: Any
) -> None:
    messages = recordings.sent(60)
    if storage == "sqlite3":
        folder = recordings.rosbag2(tmp_path / "bag", messages, storage="sqlite3")
        with closing(sqlite3.connect(next(folder.glob("*.db3")))) as database, database:
            database.execute("DELETE FROM messages WHERE id > 40")
    else:
        folder = tmp_path / "bag"
        folder.mkdir()
        path = recordings.mcap(folder / "bag_0.mcap", messages, chunked=False)
        counts = Counter((message.topic, message.msgtype) for message in messages)
        listed = [
            {"topic_metadata": {"name": topic, "type": msgtype}, "message_count": count}
            for (topic, msgtype), count in counts.items()
        ]
        write_metadata(
            folder,
            {
                "version": 5,
                "relative_file_paths": ["bag_0.mcap"],
                "message_count": 60,
                "topics_with_message_count": listed,
            },
        )
        path.write_bytes(path.read_bytes()[: record_ends(path)[40]])
    with open_recording(folder, resolve=recordings.blind) as recording:
        read = recordings.received(recording)
        assert 0 < len(read) < 60
        losses = [item.count for item in recording.unreadable]
        assert None in losses or len(read) + sum(losses) == 60
        assert losses


def record_ends(path: Path) -> list[int]:
    """Return the offsets behind the messages of an MCAP file without chunks."""
    content = path.read_bytes()
    position, ends = 8, list[int]()
    while position < len(content) - 8:
        position += 9 + int.from_bytes(content[position + 1 : position + 9], "little")
        if content[position : position + 1] == b"\x05":
            ends.append(position)
    return ends


@pytest.mark.parametrize(
    "content", ["{", "[]", "rosbag2_bagfile_information: 3", "a: &a [*a]", "[" * 9000, BOMB]
)
def test_discover_unreadable_metadata_is_finding(split: Path, recordings: Any, content: str) -> None:
    (split / "metadata.yaml").write_text(content)
    with open_recording(split, resolve=recordings.blind) as recording:
        assert len(recordings.received(recording)) == 90
        assert [finding.rule for finding in recording.findings] == ["metadata-unreadable"]


def test_discover_old_metadata_finds_listed_files(tmp_path: Path, split: Path, recordings: Any) -> None:
    old = tmp_path / "old"
    old.mkdir()
    content = (split / "part_8.mcap").read_bytes()
    (old / "part_8.mcap.zstd").write_bytes(zstandard.compress(content))
    topic = {"topic_and_type": {"name": "/imu", "type": "sensor_msgs/Imu"}, "message_count": 0}
    write_metadata(
        old, {"version": 1, "relative_file_paths": ["old/part_8.mcap"], "topics_with_message_count": [topic]}
    )
    assert [file.name for file in discover([old]).files] == ["part_8.mcap.zstd"]
    with open_recording(old, resolve=recordings.blind) as recording:
        assert len(recordings.received(recording)) == 30
        assert not any("sensor_msgs/Imu" in finding.message for finding in recording.findings)


def test_open_detects_format_by_content(tmp_path: Path, recordings: Any) -> None:
    messages = recordings.sent(20)
    result = recordings.rosbag2(tmp_path / "x.bag", messages, storage="sqlite3")
    with open_recording(result, resolve=recordings.blind) as recording:
        assert recording.container == "sqlite3"
    shutil.copy(next(result.glob("*.db3")), tmp_path / "y.mcap")
    with open_recording(tmp_path / "y.mcap", resolve=recordings.blind) as recording:
        assert recording.container == "sqlite3"
        assert recordings.received(recording) == sorted(messages)


def test_open_other_file_raises_with_first_bytes(tmp_path: Path, recordings: Any) -> None:
    files = {
        "empty.bag": b"",
        "text.mcap": b"hello, world, this is text",
        "old.bag": b"#ROSRECORD V1.1\n....",
        "header.bag": b"#ROSBAG V2.0\n",
        "twice.zstd": zstandard.compress(zstandard.compress(b"MCAP")),
        "other.db3": b"SQLite format 3\x00" + b"\0" * 100,
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    actual: dict[str, str] = {}
    for name in files:
        with pytest.raises(BagError) as caught:
            open_recording(tmp_path / name, resolve=recordings.blind)
        actual[name] = str(caught.value)
        assert str(tmp_path / name) in actual[name]
        assert "\n" not in actual[name]
    assert "the file is empty" in actual["empty.bag"]
    assert "68 65 6c 6c 6f" in actual["text.mcap"]
    assert "'#ROSRECORD V1.1'" in actual["old.bag"]
    assert "28 b5 2f fd" in actual["twice.zstd"]


def test_discover_directory_without_recording_raises_with_entries(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(BagError, match=r"without a recording; it holds notes\.txt"):
        discover([tmp_path])
    with pytest.raises(BagError, match="does not exist"):
        discover([tmp_path / "nowhere"])
    with pytest.raises(BagError, match="no path given"):
        discover([])


def test_discover_metadata_without_existing_files_uses_directory(split: Path, recordings: Any) -> None:
    info = read_info(split)
    write_metadata(split, info | {"relative_file_paths": ["gone.mcap"]})
    assert len(discover([split]).files) == 3
    assert rules(split, recordings) == ["missing-split"]
    with open_recording(split, resolve=recordings.blind) as recording:
        assert recording.unreadable == ()
    for file in split.glob("*.mcap"):
        file.unlink()
    with pytest.raises(BagError, match=r"none of the listed files exists: gone\.mcap"):
        discover([split])


def test_open_damaged_split_is_unreadable_range_and_finding(split: Path, recordings: Any) -> None:
    (split / "part_10.mcap").write_bytes(b"")
    with open_recording(split, resolve=recordings.blind) as recording:
        assert len(recordings.received(recording)) == 60
        assert "unreadable-range" in [finding.rule for finding in recording.findings]
        assert [loss.reason for loss in recording.unreadable] == [
            "this split cannot be opened: the file is empty"
        ]
    for file in split.glob("*.mcap"):
        file.write_bytes(b"")
    with pytest.raises(BagError, match="the file is empty; the other 2 splits cannot be opened either"):
        open_recording(split, resolve=recordings.blind)


@pytest.mark.parametrize("content", [b"", b"\x89MC", b"anything"])
def test_open_damaged_split_without_metadata_is_unreadable_range(
    split: Path, recordings: Any, content: bytes
) -> None:
    (split / "metadata.yaml").unlink()
    (split / "part_9.mcap").write_bytes(content)
    (split / "notes.txt").write_bytes(b"not mine")
    with open_recording(split, resolve=recordings.blind) as recording:
        assert len(recordings.received(recording)) == 60
        assert {Path(loss.file).name for loss in recording.unreadable} == {"part_9.mcap"}
    for number in (8, 10):
        (split / f"part_{number}.mcap").write_bytes(content)
    with pytest.raises(BagError, match=r"part_8\.mcap"):
        open_recording(split, resolve=recordings.blind)


def test_discover_sorts_names_with_non_decimal_digits(split: Path) -> None:
    part = split / "part_10.mcap"
    part.rename(split / "part_5\N{SUPERSCRIPT TWO}1.mcap")
    (split / "metadata.yaml").unlink()
    assert len(discover([split]).files) == 3


def test_discover_ignores_hidden_files(split: Path) -> None:
    (split / "metadata.yaml").unlink()
    (split / "._part_8.mcap").write_bytes(b"what a Mac leaves")
    assert [file.name for file in discover([split]).files] == ["part_8.mcap", "part_9.mcap", "part_10.mcap"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("version: 5\n", {}),
        ("version: 9\ncustom_data: ~\n", {}),
        ("rosbag2_bagfile_information:\n  custom_data: null\n", {}),
        ("custom_data: {}\n", {}),
        ("custom_data: {vehicle: r1}\n", {"vehicle": "r1"}),
        ("custom_data:\n  vehicle: r1\n", {"vehicle": "r1"}),
        ('"custom_data": {vehicle: ~}\n', {"vehicle": ""}),
        ("ros_distro: |\n  custom_data: ~\ncustom_data: {vehicle: r1}\n", {"vehicle": "r1"}),
    ],
)
def test_may_have_custom_data_is_false_only_without_custom_data(text: str, expected: dict[str, str]) -> None:
    assert parse_metadata(text, Path("a.mcap"), is_embedded=True).custom_data == expected
    assert may_have_custom_data(text) == bool(expected)
