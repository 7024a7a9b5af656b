"""Bags of version 1.2, in which each record states its topic and type."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.loader import ROSLoader
from mosaico_ingest.rosbag.recording import open_recording

HEADER = "=" * 80 + "\nMSG: roslib/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
TEXT = "string data\n"


def field(name: str, value: bytes) -> bytes:
    return struct.pack("<I", len(name) + 1 + len(value)) + name.encode() + b"=" + value


def record(data: bytes, **fields: bytes) -> bytes:
    header = b"".join(field(name, value) for name, value in fields.items())
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data


def definition(topic: str, msgtype: str, text: str = TEXT, md5: bytes = b"0" * 32) -> bytes:
    fields = {
        "def": text.encode(),
        "md5": md5,
        "op": b"\1",
        "topic": topic.encode(),
        "type": msgtype.encode(),
    }
    return record(b"", **fields)


def message(
    topic: str, msgtype: str, time_ns: int, payload: bytes, *, md5: bytes = b"0" * 32, latching: bytes = b"0"
) -> bytes:
    sec, nsec = divmod(time_ns, 1_000_000_000)
    return record(
        payload,
        latching=latching,
        md5=md5,
        nsec=struct.pack("<I", nsec),
        op=b"\2",
        sec=struct.pack("<I", sec),
        topic=topic.encode(),
        type=msgtype.encode(),
    )


def bag(messages: Sequence[Any], *, indexed: bool = True, line: bytes = b"#ROSRECORD V1.2\n") -> bytes:
    """Return a bag with each topic's definition before its first message, and an index at the end."""
    out = line
    if indexed:
        out += record(b" " * 4000, index_pos=b"INDEXPOS", op=b"\3")
    entries: dict[str, bytes] = {}
    for sent in messages:
        if sent.topic not in entries:
            entries[sent.topic] = b""
            out += definition(sent.topic, sent.msgtype)
        sec, nsec = divmod(sent.time_ns, 1_000_000_000)
        entries[sent.topic] += struct.pack("<IIQ", sec, nsec, len(out))
        out += message(sent.topic, sent.msgtype, sent.time_ns, sent.payload)
    out = out.replace(b"INDEXPOS", struct.pack("<Q", len(out)))
    for topic, actual in entries.items() if indexed else ():
        count = struct.pack("<I", len(actual) // 16)
        out += record(actual, count=count, op=b"\4", topic=topic.encode(), ver=bytes(4))
    return out


@pytest.fixture
def texts(recordings: Any) -> list[Any]:
    """Thirty distinct messages of three topics."""
    return [
        recordings.Sent(f"/t{n % 3}", "std_msgs/msg/String", 10**18 + n * 10**8, b"<%d>" % n + b"x" * n)
        for n in range(30)
    ]


def test_rosrecord_with_or_without_index_yields_every_message(tmp_path: Path, recordings: Any) -> None:
    messages = recordings.sent(300, cdr=False, big=True)
    for number, content in enumerate(
        (bag(messages), bag(messages, indexed=False), bag(messages, line=b"#ROSRECORD V1.2\r\n"))
    ):
        path = tmp_path / f"{number}.bag"
        path.write_bytes(content)
        with open_recording(path, resolve=recordings.blind) as recording:
            assert recordings.received(recording) == sorted(messages)
            assert recording.message_count == len(messages)
            assert not recording.unreadable
            assert any("version 1.2" in finding.message for finding in recording.findings)


def test_rosrecord_selects_topics_and_times(tmp_path: Path, recordings: Any) -> None:
    messages = recordings.sent(300, cdr=False, big=True)
    path = tmp_path / "a.bag"
    path.write_bytes(bag(messages))
    middle = messages[150].time_ns
    with open_recording(path, resolve=recordings.blind) as recording:
        (imu,) = [channel.id for channel in recording.connections if channel.topic == "/imu"]
        actual = recordings.received(recording, connection_ids=[imu], start_ns=middle)
    assert actual == sorted(sent for sent in messages if sent.topic == "/imu" and sent.time_ns >= middle)


def test_rosrecord_uses_definition_of_recording(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    stamped = struct.pack("<III", 5, 1, 2) + struct.pack("<I", 3) + b"map" + struct.pack("<f", 0.5)
    path.write_bytes(
        b"#ROSRECORD V1.2\n"
        + definition("/old", "robot_msgs/Old", "roslib/Header header\nfloat32 x\n" + HEADER)
        + message("/old", "robot_msgs/Old", 10**18, stamped, latching=b"1")
        + message("/same_type", "robot_msgs/Old", 10**18, stamped)
    )
    with ROSLoader(path) as loader:
        (first, _), (second, _) = loader
    stamp = {"sec": 1, "nanosec": 2}
    assert first.data == {"header": {"seq": 5, "stamp": stamp, "frame_id": "map"}, "x": 0.5}
    assert second.data == first.data
    with open_recording(path, resolve=TypeResolver()) as recording:
        assert {channel.topic: channel.latched for channel in recording.connections} == {
            "/old": True,
            "/same_type": False,
        }


def test_rosrecord_uses_distro_definition_only_with_same_hash(tmp_path: Path) -> None:
    right, wrong = b"992ce8a1687cec8c8bd883ec73ca41d1", b"0" * 32
    path = tmp_path / "a.bag"
    path.write_bytes(
        b"#ROSRECORD V1.2\n"
        + message("/right", "std_msgs/String", 10**18, b"\2\0\0\0hi", md5=right)
        + message("/wrong", "std_msgs/String", 10**18, b"\2\0\0\0hi", md5=wrong)
    )
    with open_recording(path, resolve=TypeResolver()) as recording:
        known = {channel.topic: channel.problem for channel in recording.connections}
    assert known["/right"] is None
    assert "the known definition of std_msgs/msg/String differs" in (known["/wrong"] or "")


@pytest.mark.slow
@pytest.mark.parametrize("indexed", [False, True])
def test_rosrecord_truncated_yields_remaining_messages_and_unreadable_range(
    tmp_path: Path, recordings: Any, texts: list[Any], *, indexed: bool
) -> None:
    texts = texts[:9]
    content = bag(texts, indexed=indexed)
    path = tmp_path / "cut.bag"
    ends = [content.index(sent.payload) + len(sent.payload) for sent in texts]
    first = len(b"#ROSRECORD V1.2\n") + (4060 if indexed else 0)
    for size in range(first, ends[-1]):
        path.write_bytes(content[:size])
        with open_recording(path, resolve=recordings.blind) as recording:
            assert recordings.received(recording) == sorted(texts[: sum(end <= size for end in ends)])
            if indexed:
                assert any("truncated" in loss.reason for loss in recording.unreadable)


def test_rosrecord_not_closed_is_read_completely(tmp_path: Path, recordings: Any, texts: list[Any]) -> None:
    content = bag(texts)
    (end,) = struct.unpack_from("<Q", content, content.index(b"index_pos=") + 10)
    path = tmp_path / "open.bag"
    path.write_bytes(content[:end].replace(b"index_pos=" + struct.pack("<Q", end), b"index_pos=" + bytes(8)))
    with open_recording(path, resolve=recordings.blind) as recording:
        assert recordings.received(recording) == sorted(texts)
        assert [(loss.count, loss.reason) for loss in recording.unreadable] == [(0, "the bag was not closed")]


def test_rosrecord_damage_loses_only_damaged_messages(
    tmp_path: Path, recordings: Any, texts: list[Any]
) -> None:
    content = bytearray(bag(texts))
    at = content.index(texts[10].payload) - 60
    content[at : at + 30] = b"\xff" * 30
    path = tmp_path / "damaged.bag"
    path.write_bytes(content)
    with open_recording(path, resolve=recordings.blind) as recording:
        actual = recordings.received(recording)
        assert len(recording.unreadable) == 1
    assert actual == sorted(texts[:10] + texts[11:])


@settings(max_examples=80, deadline=20_000, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_open_any_damage_yields_blocks_or_raises_bag_error(
    tmp_path: Path, recordings: Any, texts: list[Any], data: st.DataObject
) -> None:
    content = bytearray(bag(texts, indexed=data.draw(st.booleans())))
    place = st.integers(16, len(content) - 1)
    for at, patch in data.draw(st.lists(st.tuples(place, st.binary(min_size=1, max_size=8)), max_size=4)):
        content[at : at + len(patch)] = patch
    path = tmp_path / "any.bag"
    path.write_bytes(content)
    try:
        with open_recording(path, resolve=recordings.blind) as recording:
            recordings.received(recording)
    except BagError as err:
        assert "\n" not in str(err)  # noqa: PT017 - what is raised only sometimes
