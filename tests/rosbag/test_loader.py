"""Iteration over the messages of a recording with `ROSLoader`."""

from __future__ import annotations

import logging
import sqlite3
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores as RosbagsStores
from rosbags.typesys import get_types_from_msg, get_typestore

from mosaico_ingest.errors import BagError, DecodeError, NothingMatched
from mosaico_ingest.job.values import LoaderErrorPolicy, Stores
from mosaico_ingest.rosbag.blocks import Encoding, ROSHeader, ROSMessage
from mosaico_ingest.rosbag.definitions.model import Embedded
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.loader import ROSLoader
from mosaico_ingest.rosbag.recording import open_recording, time_slices
from mosaico_ingest.rosbag.serialization import Deserializer, Serializer

IMU, STRING, POINT = "sensor_msgs/msg/Imu", "std_msgs/msg/String", "geometry_msgs/msg/PointStamped"
ORIGIN = {"x": 0.0, "y": 0.0, "z": 0.0}
SECOND = 1_000_000_000


def payload(msgtype: str, values: dict[str, object], text: str | None = None) -> bytes:
    embedded = None if text is None else Embedded("ros2msg", text)
    known = TypeResolver(Stores.ROS2_HUMBLE).resolve(msgtype, embedded, ros_version=2)
    return Serializer(known, Encoding.CDR).from_dict(values)


def point(second: int) -> bytes:
    header = {"stamp": {"sec": second, "nanosec": 5}, "frame_id": "map"}
    return payload(POINT, {"header": header, "point": {**ORIGIN, "x": float(second)}})


@pytest.fixture(params=[StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def bag(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Twenty seconds: a point every second, a text every two seconds, one invalid text, and one custom type."""
    path = tmp_path / "bag"
    store = get_typestore(RosbagsStores.ROS2_HUMBLE)
    own = "uint8[] blob\nint32 from\n"
    with Writer(path, version=9, storage_plugin=request.param) as writer:
        points = writer.add_connection("/point", POINT, typestore=store)
        texts = writer.add_connection("/text", STRING, typestore=store)
        mine = writer.add_connection("/mine", "mine/msg/Own", msgdef=own, rihs01="RIHS01_00")
        for second in range(20):
            if second % 2 == 0:
                body = payload(STRING, {"data": f"at {second}"})
                writer.write(texts, second * SECOND, body[:-2] if second == 8 else body)
            writer.write(points, second * SECOND + 1, point(second))
        writer.write(mine, 3 * SECOND, payload("mine/msg/Own", {"blob": b"abc", "from": 7}, own))
    return path


def test_loader_yields_messages_by_log_time(bag: Path) -> None:
    with ROSLoader(bag) as loader:
        messages = list(loader)
    times = [message.timestamp_ns for message, _ in messages]
    assert times == sorted(times)
    assert len(messages) == 20 + 10 + 1
    [(message, error)] = [(message, error) for message, error in messages if error is not None]
    assert (message.topic, message.timestamp_ns, message.data) == ("/text", 8 * SECOND, {})
    assert isinstance(error, DecodeError)
    assert loader.rejected == {"/text": 1}


def test_loader_message_has_fields_by_name(bag: Path) -> None:
    with ROSLoader(bag, topics="/mine") as loader:
        ((message, _),) = loader
    assert message == ROSMessage(3 * SECOND, "/mine", "mine/msg/Own", {"blob": b"abc", "from": 7})
    assert message.header is None


def test_message_header_is_parsed_or_none(bag: Path) -> None:
    with ROSLoader(bag, topics=["/point"]) as loader:
        message, _ = next(iter(loader))
    assert message.header == ROSHeader(stamp_ns=5, frame_id="map")
    assert message.header.stamp.to_nanoseconds() == 5
    assert ROSMessage(0, "/t", "a/msg/B", {"header": 5}).header is None
    ros1 = {"header": {"seq": 4, "stamp": {"sec": 1, "nanosec": 2}, "frame_id": "f"}}
    assert ROSMessage(0, "/t", "a/msg/B", ros1).header == ROSHeader(SECOND + 2, "f", 4)


@pytest.mark.parametrize("max_bytes", [1, 50, 200])
def test_time_slices_beyond_limit_are_halved(bag: Path, max_bytes: int) -> None:
    with open_recording(bag, resolve=TypeResolver()) as recording:
        ids = [connection.id for connection in recording.connections]
        stretches = [batches for batches in time_slices(recording, ids, max_bytes=max_bytes) if batches]
        times = [[int(t) for batch in batches for t in batch.log_times] for batches in stretches]
        assert len(stretches) > 5
        assert sum(map(len, times)) == 31
        assert all(max(earlier) < min(later) for earlier, later in pairwise(times))


def test_loader_iterates_repeatedly(bag: Path) -> None:
    with ROSLoader(bag) as loader:
        first, second = list(loader), list(loader)
        assert [message for message, _ in first] == [message for message, _ in second]
        assert loader.rejected == {"/text": 1}


def test_loader_reports_topics_types_counts_and_duration(bag: Path) -> None:
    with ROSLoader(bag, topics=["!/mine"]) as loader:
        assert loader.topics == ["/point", "/text"]
        assert loader.msg_types == [POINT, STRING]
        assert (loader.msg_count(), loader.msg_count("/text")) == (30, 10)
        assert loader.duration == 19 * SECOND + 1
        with pytest.raises(NothingMatched, match="'/mine' is not selected"):
            loader.msg_count("/mine")


def test_loader_unmatched_pattern_raises_with_nearest_topics(bag: Path) -> None:
    with pytest.raises(NothingMatched, match=r"no topic matches /pint .* nearest: /point"):
        ROSLoader(bag, topics=["/pint"])


class TestPolicies:
    @pytest.mark.promise("loader-raise")
    def test_policy_raise_stops_at_first_invalid_message(self, bag: Path) -> None:
        with ROSLoader(bag, error_policy=LoaderErrorPolicy.RAISE) as loader:
            with pytest.raises(DecodeError, match=r"^/text at 8000000000 ns: data: ") as caught:
                list(loader)
            assert caught.value.rule == "string-length"

    def test_policy_raise_keeps_the_hint(self, bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(Deserializer, "_remedy", lambda *_: "use the definition of ros2_iron")
        loader = ROSLoader(bag, error_policy=LoaderErrorPolicy.RAISE)
        with loader, pytest.raises(DecodeError, match="use the definition of ros2_iron"):
            list(loader)

    @pytest.mark.promise("loader-log-warn")
    def test_policy_log_warn_logs_and_continues(self, bag: Path, caplog: pytest.LogCaptureFixture) -> None:
        with caplog.at_level(logging.WARNING, "mosaico_ingest.rosbag"), ROSLoader(bag) as loader:
            list(loader)
        assert "/text: 1 messages could not be read" in caplog.messages

    @pytest.mark.promise("loader-ignore")
    def test_policy_ignore_counts_silently(self, bag: Path, caplog: pytest.LogCaptureFixture) -> None:
        with ROSLoader(bag, error_policy="ignore") as loader:
            list(loader)
        assert (caplog.messages, loader.rejected["/text"]) == ([], 1)


class TestDefinitions:
    @pytest.fixture
    def old_bag(self, tmp_path: Path) -> Path:
        """A database without definitions, as before ROS 2 Iron."""
        path = tmp_path / "old"
        store = get_typestore(RosbagsStores.ROS2_HUMBLE)
        with Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
            texts = writer.add_connection("/text", STRING, typestore=store)
            mine = writer.add_connection("/mine", "mine/msg/Own", msgdef="int8 x", rihs01="RIHS01_00")
            writer.write(texts, 1, payload(STRING, {"data": "a"}))
            writer.write(mine, 2, payload("mine/msg/Own", {"x": 5}, "int8 x"))
        database = next(path.glob("*.db3"))
        import sqlite3  # noqa: PLC0415 - only here

        with sqlite3.connect(database) as connection:
            connection.execute("DELETE FROM message_definitions")
        connection.close()
        return path

    def test_unknown_type_rejects_only_its_topic(self, old_bag: Path) -> None:
        with ROSLoader(old_bag, error_policy="ignore") as loader:
            assert [(message.topic, error is None) for message, error in loader] == [
                ("/text", True),
                ("/mine", False),
            ]
            assert loader.rejected == {"/mine": 1}
            assert any(finding.rule == "assumed-definition" for finding in loader.findings)

    def test_unknown_type_with_policy_raise_raises(self, old_bag: Path) -> None:
        with (
            ROSLoader(old_bag, error_policy="raise") as loader,
            pytest.raises(BagError, match=r"^/mine: .*mine/msg/Own.*searched"),
        ):
            list(loader)

    def test_custom_types_define_the_type(self, old_bag: Path) -> None:
        with ROSLoader(
            old_bag, Stores.ROS2_HUMBLE, ["/mine"], custom_types={"mine/msg/Own": "int8 x"}
        ) as loader:
            assert [message.data for message, _ in loader] == [{"x": 5}]


def test_loader_reads_ros1_bag(tmp_path: Path) -> None:
    path = tmp_path / "one.bag"
    store = get_typestore(RosbagsStores.ROS1_NOETIC)
    known = TypeResolver(Stores.ROS1_NOETIC).resolve("std_msgs/Header", None, ros_version=1)
    values = {"seq": 3, "stamp": {"sec": 1, "nanosec": 2}, "frame_id": "f"}
    with Writer1(path) as writer:
        connection = writer.add_connection("/header", "std_msgs/msg/Header", typestore=store)
        writer.write(connection, 5, Serializer(known, Encoding.ROS1).from_dict(values))
    with ROSLoader(str(path)) as loader:
        assert [message for message, _ in loader] == [ROSMessage(5, "/header", "std_msgs/msg/Header", values)]


def test_loader_missing_file_raises(tmp_path: Path) -> None:
    with pytest.raises(BagError):
        ROSLoader(tmp_path / "missing.mcap")


def test_loader_positional_parameters_are_those_of_the_sdk(bag: Path) -> None:
    with ROSLoader(bag, Stores.ROS2_HUMBLE, ["/po*"], {"mine/msg/Own": "ragged"}) as loader:
        assert loader.topics == ["/point"]
        assert loader.filtered_topics == ["/mine", "/text"]
        assert loader.resolved_topics == ["/mine", "/point", "/text"]


def test_loader_with_typestore_uses_its_definitions(tmp_path: Path) -> None:
    typestore = get_typestore(RosbagsStores.ROS2_HUMBLE)
    typestore.register(get_types_from_msg("std_msgs/Header header\nuint8[] blob\n", "mine/msg/Own"))
    path = tmp_path / "bag"
    with Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/mine", "mine/msg/Own", typestore=typestore)
        header = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "f"}
        text = "std_msgs/Header header\nuint8[] blob\n"
        writer.write(connection, 5, payload("mine/msg/Own", {"header": header, "blob": b"abc"}, text))
    with closing(sqlite3.connect(next(path.glob("*.db3")))) as database:
        database.execute("DROP TABLE message_definitions")
        database.commit()
    with ROSLoader(path, "ros2_humble", error_policy="ignore") as loader:
        assert loader.resolved_topics == []
        assert [(message.data_field, type(error)) for message, error in loader] == [(None, DecodeError)]
    with ROSLoader(path, typestore) as loader:
        ((message, _),) = loader
        assert loader.resolved_topics == ["/mine"]
    assert message.data == {"header": header, "blob": b"abc"}
