"""Topics that other tools drop, corrupt or fail on: all of one recording are stored completely."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest
from made_recordings import define, record

from mosaico_ingest import RosbagInjector, ROSInjectionConfig
from mosaico_ingest.destinations.store import Store

BAR = "=" * 80
Rows = list[dict[str, Any]]
AWKWARD: Mapping[str, tuple[str, str, Rows, Rows]] = {
    "/bounded": (
        "a/msg/Bounded",
        "int32[<=3] few\nstring<=5 word\n",
        [{"few": [], "word": ""}, {"few": [7, 8], "word": "ab"}],
        [{"few": [], "word": ""}, {"few": [7, 8], "word": "ab"}],
    ),
    "/wide": ("a/msg/Wide", "wstring text\n", [{"text": "żółw"}], [{"text": "żółw"}]),
    "/same": ("a/msg/Same", "int32 A=1\nint32 v\n", [{"v": 1}], [{"v": 1}]),
    "/other_same": ("b/msg/Same", "int32 B=2\nint32 v\n", [{"v": 2}], [{"v": 2}]),
    "/header_is_text": (
        "a/msg/Letter",
        "string header\nint32 v\n",
        [{"header": "hi", "v": 3}],
        [{"header": "hi", "v": 3}],
    ),
    "/header_of_its_own": (
        "a/msg/Packet",
        f"a/Preamble header\n{BAR}\nMSG: a/Preamble\nint32 length\n",
        [{"header": {"length": 4}}],
        [{"header": {"length": 4}}],
    ),
    "/empty": ("std_msgs/msg/Empty", "", [{}, {}], [{}, {}]),
    "/constants_only": ("a/msg/Codes", "int32 OK=0\n", [{}], [{}]),
    "/limits": ("a/msg/Limits", "float64 NONE=nan\nfloat64 FAR=inf\nint32 v\n", [{"v": 5}], [{"v": 5}]),
    "/stamped": ("a/msg/Stamped", "int64 timestamp_ns\n", [{"timestamp_ns": 6}], [{"timestamp_ns_": 6}]),
    "/_hidden": ("std_msgs/msg/Int32", "int32 data\n", [{"data": 7}], [{"data": 7}]),
    "/arrays": (
        "a/msg/Arrays",
        "bool[2] flags\nuint8[] bytes\nfloat32[2] fixed\n",
        [{"flags": [True, False], "bytes": b"\x00\xff", "fixed": [0.5, 1.5]}],
        [{"flags": [True, False], "bytes": b"\x00\xff", "fixed": [0.5, 1.5]}],
    ),
}


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Store:
    folder = tmp_path_factory.mktemp("awkward")
    recording = record(
        folder / "awkward.mcap",
        [
            (topic, define(msgtype, text), 10 + at, row)
            for topic, (msgtype, text, rows, _) in AWKWARD.items()
            for at, row in enumerate(rows)
        ],
    )
    report = RosbagInjector(ROSInjectionConfig(recording, "awkward", store=folder / "store")).run()
    assert report.totals.read == report.totals.written == sum(len(rows) for *_, rows in AWKWARD.values())
    return Store.open(folder / "store")


@pytest.mark.parametrize("topic", AWKWARD)
def test_awkward_topic_is_stored_with_every_row(stored: Store, topic: str) -> None:
    rows = stored.scan("awkward", topic).read_all().to_pylist()
    assert [row.pop("timestamp_ns") for row in rows] == [10 + at for at in range(len(rows))]
    assert rows == AWKWARD[topic][3]


def test_types_with_equal_short_names_keep_their_definitions(stored: Store) -> None:
    origins = [stored.topic("awkward", topic).metadata["_ros_"] for topic in ("/same", "/other_same")]
    assert [origin["msgtype"] for origin in origins] == ["a/msg/Same", "b/msg/Same"]
    assert [origin["enums"] for origin in origins] == [{"A": 1}, {"B": 2}]
    assert [origin["msgdef"] for origin in origins] == ["int32 A=1\nint32 v\n", "int32 B=2\nint32 v\n"]


@pytest.mark.parametrize(
    ("topics", "rename", "clash"),
    [
        (("/a", "/b"), {"/b": "/a"}, "/a and /b have one name in the sequence, /a"),
        (("imu", "/imu"), {}, "imu and /imu have one name in the sequence, imu"),
    ],
    ids=["renamed to the name of another", "with and without a slash"],
)
def test_topics_with_equal_names_in_the_sequence_are_both_stored_with_a_finding(
    tmp_path: Path, topics: tuple[str, str], rename: dict[str, str], clash: str
) -> None:
    number = define("std_msgs/msg/Int32", "int32 data\n")
    recording = record(tmp_path / "two.mcap", [(topic, number, 5, {"data": 1}) for topic in topics])
    config = ROSInjectionConfig(
        recording,
        "two",
        store=tmp_path / "store",
        manifest={"topic_settings": {topic: {"rename": name} for topic, name in rename.items()}},
    )
    report = RosbagInjector(config).run()
    assert report.totals.written == 2
    first, second = (topic.target for topic in report.topics)
    assert second.endswith(f"{topics[0].removeprefix('/')}/Int32")
    assert [finding for finding in report.findings if "name-clash" in finding] == [
        f"warning[name-clash] {clash} — the second one is stored as {second}"
    ]
    stored = Store.open(tmp_path / "store").sequence("two").topics
    assert [topic.rows for topic in stored] == [1, 1]
    assert first == topics[0]


def test_topic_with_two_types_gives_one_finding_if_selected(tmp_path: Path) -> None:
    number, text = (
        define("std_msgs/msg/Int32", "int32 data\n"),
        define("std_msgs/msg/String", "string data\n"),
    )
    recording = record(
        tmp_path / "two.mcap",
        [
            ("/two", number, 5, {"data": 1}),
            ("/two", text, 6, {"data": "a"}),
            ("/one", number, 7, {"data": 2}),
        ],
    )
    config = ROSInjectionConfig(recording, "two", store=tmp_path / "store")
    both, without = (
        RosbagInjector(one).run() for one in (config, replace(config, sequence_name="one", topics="/one"))
    )
    assert [finding.partition("]")[0] for finding in both.findings] == ["warning[mixed-types"]
    assert without.findings == ()


def test_assumed_definition_of_excluded_topic_gives_no_finding(tmp_path: Path) -> None:
    number = define("std_msgs/msg/Int32", "int32 data\n")
    undefined = msgspec.structs.replace(define("std_msgs/msg/String", "string data\n"), text="")
    recording = record(
        tmp_path / "two.mcap", [("/one", number, 5, {"data": 1}), ("/other", undefined, 6, {"data": ""})]
    )
    config = ROSInjectionConfig(recording, "two", store=tmp_path / "store")
    assert [finding.rule for finding in RosbagInjector(config).plan().findings] == ["assumed-definition"]
    assert RosbagInjector(replace(config, topics="/one")).plan().findings == ()
