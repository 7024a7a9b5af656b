"""Recordings in every container, written by rosbags and by a small MCAP writer that can omit records."""

from __future__ import annotations

import random
import struct
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import lz4.frame
import pytest
import zstandard
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.definitions.model import (
    Definition,
    Embedded,
    MessageType,
    Source,
)
from mosaico_ingest.rosbag.recording import Recording

START_NS = 1_700_000_000_000_000_000


class Sent(NamedTuple):
    """One message as a test records it."""

    topic: str
    msgtype: str
    time_ns: int
    payload: bytes


class BlindResolver:
    """A type store without types, since containers do not need them."""

    def resolve(self, msgtype: str, embedded: Embedded | None, *, ros_version: int) -> Definition:
        raise BagError(f"{msgtype} of ROS {ros_version} is not known, nor from {embedded}")


class EasyResolver:
    """A type store in which every type exists and is empty."""

    def resolve(self, msgtype: str, embedded: Embedded | None, *, ros_version: int) -> Definition:
        types = {msgtype: MessageType(msgtype, ())}
        return Definition(msgtype, types, Source.DISTRO, embedded.text if embedded else "", ros_version)


def sent(count: int = 300, *, seed: int = 0, big: bool = False, cdr: bool = True) -> list[Sent]:
    """Return messages of a few topics in time order, of fixed and random lengths, some with equal times."""
    rng = random.Random(seed)  # noqa: S311 - test data
    head = b"\x00\x01\x00\x00" if cdr else b""
    actual: list[Sent] = []
    for number in range(count):
        topic, msgtype, size = rng.choice(
            [
                ("/imu", "sensor_msgs/msg/Imu", 324),
                ("/chatter", "std_msgs/msg/String", rng.randrange(200)),
                ("/empty", "std_msgs/msg/Empty", 0),
                ("/image", "sensor_msgs/msg/Image", rng.randrange(20_000, 90_000) if big else 700),
            ]
        )
        actual.append(Sent(topic, msgtype, START_NS + number // 2 * 10_000_000, head + rng.randbytes(size)))
    return actual


def write_rosbag2(
    path: Path, messages: Iterable[Sent], *, storage: str = "mcap", compression: str = "none"
) -> Path:
    """Write a rosbag2 directory; `compression` is none, file, message or storage."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    plugin = rosbag2.StoragePlugin.MCAP if storage == "mcap" else rosbag2.StoragePlugin.SQLITE3
    writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    mode = rosbag2.CompressionMode[compression.upper()]
    writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for message in messages:
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(
                    message.topic, message.msgtype, typestore=store
                )
            writer.write(connections[message.topic], message.time_ns, message.payload)
    return path


def write_ros1(
    path: Path, messages: Iterable[Sent], *, compression: str = "none", chunk_bytes: int = 1 << 20
) -> Path:
    """Write a ROS 1 bag; `compression` is none, bz2 or lz4."""
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = rosbag1.Writer(path)
    writer.chunk_threshold = chunk_bytes
    if compression != "none":
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
    with writer:
        connections = {}
        for message in messages:
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(
                    message.topic, message.msgtype, typestore=store
                )
            writer.write(connections[message.topic], message.time_ns, message.payload)
    return path


def write_mcap(
    path: Path,
    messages: Sequence[Sent],
    *,
    compression: str = "zstd",
    chunk_messages: int = 50,
    chunked: bool = True,
    indexed: bool = True,
    summary: bool = True,
    encoding: str = "cdr",
) -> Path:
    """Write an MCAP file, with or without chunks, message indexes and summary."""
    writer = _McapWriter(compression, encoding, indexed=indexed)
    writer.record(1, _text("") + _text("test"))
    if chunked:
        for begin in range(0, len(messages), chunk_messages):
            writer.chunk(messages[begin : begin + chunk_messages])
    else:
        for message in messages:
            writer.out += writer.described(message) + writer.message(message)[0]
    writer.record(15, bytes(4))
    writer.end(messages, summary=summary)
    path.write_bytes(writer.out)
    return path


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()


def _record(op: int, body: bytes) -> bytes:
    return struct.pack("<BQ", op, len(body)) + body


_PACK: dict[str, Callable[[bytes], bytes]] = {
    "": bytes,
    "zstd": zstandard.ZstdCompressor().compress,
    "lz4": lz4.frame.compress,
}


class _McapWriter:
    def __init__(self, compression: str, encoding: str, *, indexed: bool) -> None:
        self.out = bytearray(b"\x89MCAP0\r\n")
        self.compression = compression
        self.encoding = encoding
        self.indexed = indexed
        self.descriptions: dict[str, tuple[int, bytes]] = {}
        self.chunk_indexes: list[bytes] = []

    def record(self, op: int, body: bytes) -> None:
        self.out += _record(op, body)

    def described(self, message: Sent) -> bytes:
        """Return the schema and channel records for the first message of a topic, else nothing."""
        if message.topic in self.descriptions:
            return b""
        key = len(self.descriptions) + 1
        schema = struct.pack("<H", key) + _text(message.msgtype) + _text("ros2msg") + _text("# text")
        channel = (
            struct.pack("<HH", key, key) + _text(message.topic) + _text(self.encoding) + struct.pack("<I", 0)
        )
        self.descriptions[message.topic] = key, _record(3, schema) + _record(4, channel)
        return self.descriptions[message.topic][1]

    def message(self, message: Sent) -> tuple[bytes, int]:
        key = self.descriptions[message.topic][0]
        return _record(
            5, struct.pack("<HIQQ", key, 0, message.time_ns, message.time_ns) + message.payload
        ), key

    def chunk(self, messages: Sequence[Sent]) -> None:
        data = bytearray()
        entries: dict[int, bytes] = defaultdict(bytes)
        for message in messages:
            data += self.described(message)
            record, key = self.message(message)
            entries[key] += struct.pack("<QQ", message.time_ns, len(data))
            data += record
        packed = _PACK[self.compression](bytes(data))
        times = min(m.time_ns for m in messages), max(m.time_ns for m in messages)
        start = len(self.out)
        head = struct.pack("<QQQI", *times, len(data), zlib.crc32(data)) + _text(self.compression)
        self.record(6, head + struct.pack("<Q", len(packed)) + packed)
        length, offsets = len(self.out) - start, b""
        for key, actual in entries.items() if self.indexed else ():
            offsets += struct.pack("<HQ", key, len(self.out))
            self.record(7, struct.pack("<HI", key, len(actual)) + actual)
        body = struct.pack("<QQQQI", *times, start, length, len(offsets)) + offsets
        body += struct.pack("<Q", len(self.out) - start - length) + _text(self.compression)
        self.chunk_indexes.append(_record(8, body + struct.pack("<QQ", len(packed), len(data))))

    def end(self, messages: Sequence[Sent], *, summary: bool) -> None:
        begin = len(self.out) if summary else 0
        if summary:
            counts: dict[int, int] = defaultdict(int)
            for message in messages:
                counts[self.descriptions[message.topic][0]] += 1
            self.out += b"".join(records for _, records in self.descriptions.values())
            self.out += b"".join(self.chunk_indexes)
            times = [message.time_ns for message in messages] or [0]
            body = struct.pack(
                "<QHIIII", len(messages), len(counts), len(counts), 0, 0, len(self.chunk_indexes)
            )
            body += struct.pack("<QQI", min(times), max(times), 10 * len(counts))
            self.record(11, body + b"".join(struct.pack("<HQ", *item) for item in counts.items()))
        foot = struct.pack("<BQQQ", 2, 20, begin, 0)
        crc = zlib.crc32(bytes(self.out[begin:]) + foot) if summary else 0
        self.out += foot + struct.pack("<I", crc) + b"\x89MCAP0\r\n"


def received(recording: Recording, **selection: object) -> list[Sent]:
    """Return all messages by time, and check the invariants of each block."""
    actual: list[Sent] = []
    last: dict[int, int] = {}
    for batch in recording.message_blocks(**selection):  # type: ignore[arg-type]  # the tests name what batches() takes
        assert len(batch)
        assert batch.starts.min() >= 0
        assert (batch.starts + batch.lengths <= len(batch.data)).all()
        assert (batch.log_times[1:] >= batch.log_times[:-1]).all()
        assert last.get(batch.connection, 0) <= batch.log_times[0]
        last[batch.connection] = int(batch.log_times[-1])
        channel = recording.connections[batch.connection]
        actual += [
            Sent(channel.topic, channel.msgtype, int(time), batch.payload(row))
            for row, time in enumerate(batch.log_times)
        ]
    return sorted(actual)


class Recordings:
    """The functions above, as attributes for tests that cannot import this module."""

    Sent = Sent
    START_NS = START_NS
    blind = BlindResolver()
    easy = EasyResolver()
    sent = staticmethod(sent)
    rosbag2 = staticmethod(write_rosbag2)
    ros1 = staticmethod(write_ros1)
    mcap = staticmethod(write_mcap)
    received = staticmethod(received)


@pytest.fixture(scope="session")
def recordings() -> Recordings:
    """Functions that write recordings and read them back."""
    return Recordings()
