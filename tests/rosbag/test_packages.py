"""Recordings without definitions, whose types belong to bundled packages and not to a distro's core."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from mosaico_ingest.errors import BagError
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.definitions import registry as packages
from mosaico_ingest.rosbag.definitions.linking import md5sum, rihs01
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded, Source, read_types
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.loader import ROSLoader
from mosaico_ingest.rosbag.recording import Recording, open_recording

NAMES = sorted(
    name
    for file in Path(packages.__file__).with_name("packages").glob("*.txt")
    for name in read_types(file.read_text(), file.stem)
)
HELLO = b"\x00\x01\x00\x00\x03\x00\x00\x00hi\x00"
STRINGS = "RIHS01_eee55533636293ac7c94c62432eedb5777eb849847d2a17b4dcead8c4a20ab32"
"""The hash of test_msgs/msg/Strings as computed by ROS."""


def recorded(
    path: Path, msgtype: str, digest: str = "", definitions: tuple[tuple[str, str], ...] = ()
) -> Path:
    """Write a recording with one message whose payload is a string."""
    with sqlite3.connect(path) as file:
        file.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format, offered_qos_profiles,"
            " type_description_hash);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data);"
            "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type, encoding,"
            " encoded_message_definition, type_description_hash)"
        )
        file.execute("INSERT INTO topics VALUES (1, '/data', ?, 'cdr', '', ?)", (msgtype, digest))
        file.execute("INSERT INTO messages VALUES (1, 1, 7, ?)", (HELLO,))
        for name, text in definitions:
            file.execute(
                "INSERT INTO message_definitions VALUES (NULL, ?, 'ros2msg', ?, ?)", (name, text, digest)
            )
    file.close()
    return path


def opened(path: Path, resolver: TypeResolver) -> Recording:
    recording = open_recording([path], resolve=resolver)
    recording.close()
    return recording


@pytest.mark.parametrize("name", NAMES)
def test_package_types_are_complete(name: str) -> None:
    definition = TypeResolver().resolve(name, None, ros_version=2)
    assert (definition.source, definition.root) == (Source.PACKAGE, name)


def test_package_types_have_the_hashes_of_ros2() -> None:
    assert rihs01(TypeResolver().resolve("test_msgs/msg/Strings", None, ros_version=2)) == STRINGS


def in_ros_1(name: str) -> Definition:
    """Return the definition of a type for ROS 1, which differs only in the header."""
    package = name.partition("/")[0]
    text = Path(packages.__file__).with_name("packages").joinpath(f"{package}.txt").read_text()
    parts = dict(part.split("\n", 1) for part in text.split(f"{'=' * 80}\n"))
    root = parts.pop(f"MSG: {name}")
    rest = "".join(f"{'=' * 80}\n{head}\n{body}" for head, body in parts.items())
    return TypeResolver(Stores.ROS1_NOETIC).resolve(name, Embedded("ros1msg", root + rest), ros_version=1)


@pytest.mark.parametrize(
    ("name", "digest"),
    [
        ("ackermann_msgs/AckermannDrive", "3512e91b48d69674a0e86fadf1ea8231"),
        ("ackermann_msgs/AckermannDriveStamped", "1fd5d7f58889cefd44d29f6653240d0c"),
        ("can_msgs/Frame", "64ae5cebf967dc6aae4e78f5683a5b25"),
        ("livox_ros_driver2/CustomMsg", "e4d6829bdfe657cb6c21a746c86b21a6"),
        ("livox_ros_driver2/CustomPoint", "109a3cc548bb1f96626be89a5008bd6d"),
        ("nmea_msgs/Sentence", "9f221efc5f4b3bac7ce4af102b32308b"),
    ],
)
def test_package_types_have_the_hashes_of_ros1(name: str, digest: str) -> None:
    """Compare with the MD5 sums in ROS 1 bags and generated code."""
    assert md5sum(in_ros_1(name)) == digest


@pytest.mark.parametrize("distro", [None, Stores.ROS2_HUMBLE])
def test_package_type_is_used_with_finding(tmp_path: Path, distro: Stores | None) -> None:
    path = recorded(tmp_path / "a.db3", "example_interfaces/msg/String")
    with ROSLoader(path, typestore_or_distro=distro) as loader:
        assert [message.data for message, _ in loader] == [{"data": "hi"}]
        (finding,) = [actual for actual in loader.findings if actual.rule == "assumed-definition"]
    assert "the public package example_interfaces are used: example_interfaces/msg/String" in finding.message
    assert finding.help == "if your types have other fields, provide them with custom_msgs"


def test_package_type_yields_to_recording_and_job(tmp_path: Path) -> None:
    name = "example_interfaces/msg/String"
    embedded = recorded(tmp_path / "a.db3", name, definitions=((name, "string text"),))
    with ROSLoader(embedded) as loader:
        assert [message.data for message, _ in loader] == [{"text": "hi"}]
    with ROSLoader(recorded(tmp_path / "b.db3", name), custom_types={name: "string mine"}) as loader:
        assert [message.data for message, _ in loader] == [{"mine": "hi"}]
        assert not any(actual.rule == "assumed-definition" for actual in loader.findings)


def test_definition_with_another_hash_is_not_used(tmp_path: Path) -> None:
    other = f"RIHS01_{'0' * 64}"
    for name in ("example_interfaces/msg/String", "std_msgs/msg/String"):
        path = recorded(tmp_path / f"{name.partition('/')[0]}.db3", name, other)
        (channel,) = opened(path, TypeResolver(Stores.ROS2_JAZZY)).connections
        assert channel.definition is None
        assert channel.problem
        assert (
            f"the known definition of {name} differs from the recorded one: the recorded hash is {other}"
            in channel.problem
        )
        (channel,) = opened(path, TypeResolver(types={name: "string data"})).connections
        assert channel.definition, "what the job says about its own recording is believed"


def test_definition_with_same_hash_is_used(tmp_path: Path) -> None:
    path = recorded(tmp_path / "a.db3", "test_msgs/msg/Strings", STRINGS)
    (channel,) = opened(path, TypeResolver()).connections
    assert channel.definition
    assert channel.definition.source is Source.PACKAGE


def test_service_events_use_definition_of_service(tmp_path: Path) -> None:
    service = (("mine/srv/Add", "int64 a\n---\nint64 sum\n"),)
    path = recorded(tmp_path / "a.db3", "mine/srv/Add_Event", definitions=service)
    (channel,) = opened(path, TypeResolver()).connections
    assert channel.definition
    assert [field.name for field in channel.definition.message.fields] == ["info", "request", "response"]


def test_package_type_is_not_used_for_ros1() -> None:
    with pytest.raises(BagError, match="is not known"):
        TypeResolver().resolve("turtlesim/Pose", None, ros_version=1)
