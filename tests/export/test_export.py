"""Export: ingested recordings are written back with equal messages."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from made_recordings import define, record
from message_differences import differences, messages_of
from rosbags.highlevel import AnyReader

from mosaico_ingest.api import run
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import AdapterError, BagError, IngestError, NothingMatched
from mosaico_ingest.export import export_sequence
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.values import TopicLevelErrorPolicy
from mosaico_ingest.rosbag.definitions.registry import TypeResolver

DRIVE = Path(__file__).parents[2] / "configs" / "quickstart" / "drive.mcap"
ODD = """
int64 timestamp_ns
acme_msgs/Nothing nothing
acme_msgs/Part[] parts
acme_msgs/Part[2] pair
uint8[3] octets
uint8[] blob
wstring wide
string[<=2] names
bool[] flags
================================================================================
MSG: acme_msgs/Nothing
================================================================================
MSG: acme_msgs/Part
float32[2] values
acme_msgs/Nothing nothing
"""
PART = {"values": [1.5, float("nan")], "nothing": {}}
ODD_VALUES: dict[str, Any] = {
    "timestamp_ns": -5,
    "nothing": {},
    "parts": [PART, PART],
    "pair": [PART, PART],
    "octets": [1, 2, 3],
    "blob": b"\x00\xff",
    "wide": "ä𝄞",
    "names": ["", "b"],
    "flags": [True, False],
}

Ingest = Callable[..., Store]


@pytest.fixture
def ingested(tmp_path: Path) -> Ingest:
    """Ingest a recording as the sequence `s`."""

    def ingest(recording: Path, **options: Any) -> Store:
        folder = tmp_path / "store"
        config = ROSInjectionConfig(file_path=recording, sequence_name="s", store=folder, **options)
        report = run([config]).recordings[0]
        assert report.error is None
        return Store.open(folder)

    return ingest


@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
def test_export_ros2_messages_equal_the_source(ingested: Ingest, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"out{suffix}"
    report = export_sequence(ingested(DRIVE), "s", out)
    assert report.faithful
    assert report.messages == 2130
    assert report.bytes == out.stat().st_size
    assert differences(DRIVE, out) == {}
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def ros_1_messages() -> list[tuple[str, Any, int, dict[str, Any]]]:
    header = "uint32 seq\ntime stamp\nstring frame_id\n"
    line = "=" * 80
    stamped = define(
        "geometry_msgs/msg/PointStamped",
        f"Header header\nPoint point\n{line}\nMSG: std_msgs/Header\n{header}"
        f"{line}\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n",
        version=1,
    )
    lone = define("acme_msgs/msg/Lone", "int16 a\n", version=1)
    values = {
        "header": {"seq": 7, "stamp": {"sec": 5, "nanosec": 6}, "frame_id": "f"},
        "point": {"x": 1.0, "y": 2.0, "z": 3.0},
    }
    return [("/p", stamped, 10, values), ("/a", lone, 11, {"a": 4}), ("/p", stamped, 12, values)]


@pytest.mark.parametrize("suffix", [".mcap", ".bag"])
def test_export_ros1_messages_equal_the_source(ingested: Ingest, tmp_path: Path, suffix: str) -> None:
    source = record(tmp_path / "in.bag", ros_1_messages())
    out = tmp_path / f"out{suffix}"
    assert export_sequence(ingested(source), "s", out).faithful
    assert differences(source, out) == {}
    with AnyReader([source]) as one:
        digests = {(c.topic, c.msgtype, c.digest) for c in one.connections}
    if suffix == ".bag":
        with AnyReader([out]) as other:
            assert {(c.topic, c.msgtype, c.digest) for c in other.connections} == digests


def test_export_ros1_topic_to_ros2_container_is_skipped_and_named(ingested: Ingest, tmp_path: Path) -> None:
    source = record(tmp_path / "in.bag", ros_1_messages())
    report = export_sequence(ingested(source), "s", tmp_path / "out.db3")
    left = {topic.topic: topic.excluded for topic in report.topics if topic.excluded}
    assert set(left) == {"/p"}
    assert "ROS 1" in left["/p"]
    assert not report.faithful


@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
def test_export_unmodeled_topic_equals_the_source(ingested: Ingest, tmp_path: Path, suffix: str) -> None:
    text = ODD if suffix == ".mcap" else ODD.replace("wstring", "string")
    odd = define("acme_msgs/msg/Odd", text)
    empty = define("std_msgs/msg/Empty", "")
    source = record(
        tmp_path / "in.mcap", [("/odd", odd, 1, ODD_VALUES), ("/e", empty, 2, {}), ("/e", empty, 2, {})]
    )
    out = tmp_path / f"out{suffix}"
    assert export_sequence(ingested(source), "s", out).faithful
    assert differences(source, out) == {}


def test_export_type_that_the_container_cannot_describe_is_skipped(ingested: Ingest, tmp_path: Path) -> None:
    odd, plain = define("acme_msgs/msg/Odd", ODD), define("std_msgs/msg/String", "string data\n")
    messages = [("/odd", odd, 1, ODD_VALUES), ("/s", plain, 2, {"data": "x"})]
    report = export_sequence(ingested(record(tmp_path / "in.mcap", messages)), "s", tmp_path / "out.db3")
    assert {topic.topic for topic in report.topics if "wstring" in topic.excluded} == {"/odd"}


def test_export_images_stored_as_png_have_the_original_pixels(ingested: Ingest, tmp_path: Path) -> None:
    store = ingested(DRIVE, manifest={"topic_settings": {"/camera/image_raw": {"image": "png"}}})
    out = tmp_path / "out.mcap"
    assert export_sequence(store, "s", out, topics=["/camera/image_raw"]).faithful
    assert set(differences(DRIVE, out).pop("/imu")) == {"(count)"}
    assert "/camera/image_raw" not in differences(DRIVE, out)


def test_export_selects_half_open_time_range_and_topic_patterns(ingested: Ingest, tmp_path: Path) -> None:
    store, out = ingested(DRIVE), tmp_path / "out.mcap"
    times = [time for time, _ in messages_of(DRIVE)["/imu"]]
    export_sequence(store, "s", out, topics=["/*", "!/c*"], start_ns=times[10], end_ns=times[20])
    written = messages_of(out)
    assert [time for time, _ in written["/imu"]] == times[10:20]
    assert not [topic for topic in written if topic.startswith("/c")]


def test_export_that_fails_leaves_no_file(ingested: Ingest, tmp_path: Path) -> None:
    store = ingested(DRIVE)
    for out, error, options in (
        ("a.mcap", NothingMatched, {"topics": ["/none"]}),
        ("a.mcap", NothingMatched, {"start_ns": 2**62}),
        ("a.bag", NothingMatched, {}),
        ("a.txt", BagError, {}),
        ("no/a.mcap", BagError, {}),
    ):
        with pytest.raises(error):
            export_sequence(store, "s", tmp_path / out, **options)
    assert [path.name for path in tmp_path.iterdir()] == ["store"]


def test_export_replaces_existing_file_only_with_force(ingested: Ingest, tmp_path: Path) -> None:
    store, out = ingested(DRIVE), tmp_path / "out.mcap"
    out.write_bytes(b"mine")
    with pytest.raises(BagError, match="file exists"):
        export_sequence(store, "s", out, topics=["/imu"])
    assert out.read_bytes() == b"mine"
    export_sequence(store, "s", out, topics=["/imu"], replace=True)
    assert len(messages_of(out)["/imu"]) == 1000


def test_export_inverts_own_adapter_if_named(ingested: Ingest, tmp_path: Path) -> None:
    own = DRIVE.parent / "adapters" / "battery_pack.yaml"
    store, out = ingested(DRIVE, manifest={"adapters": {"load": [own]}}), tmp_path / "out.mcap"
    with pytest.raises(NothingMatched, match="--adapter"):
        export_sequence(store, "s", out, topics=["/battery"])
    assert export_sequence(store, "s", out, topics=["/battery"], adapters=[str(own)]).faithful
    assert "/battery" not in differences(DRIVE, out)


def test_export_names_columns_that_cannot_be_inverted(ingested: Ingest, tmp_path: Path) -> None:
    adapter = tmp_path / "sum.yaml"
    adapter.write_text(
        "version: 1\nadapter: SumAdapter\nros_type: acme_msgs/msg/Two\n"
        "ontology: {tag: Sum, fields: {sum: float64, a: float64}}\nfields: {sum: a + b, a: a}\n"
    )
    two = define("acme_msgs/msg/Two", "float64 a\nfloat64 b\n")
    source = record(tmp_path / "in.mcap", [("/t", two, 1, {"a": 1.0, "b": 2.0})])
    store = ingested(source, manifest={"adapters": {"load": [adapter]}})
    (topic,) = export_sequence(store, "s", tmp_path / "out.mcap", adapters=[str(adapter)]).topics
    assert topic.not_invertible == {"sum": "a + b"}
    assert topic.defaulted == ("b",)
    assert topic.changed == {"sum": 1}
    assert not topic.faithful


def test_export_topic_without_definition_uses_that_of_the_distro(ingested: Ingest, tmp_path: Path) -> None:
    store = ingested(DRIVE)
    with store.catalog.write() as db:
        db.execute("UPDATE topics SET metadata = '{}' WHERE name IN ('/imu', '/odom', '/battery')")
    out = tmp_path / "out.mcap"
    topics = ["/imu", "/odom", "/battery"]
    report = export_sequence(store, "s", out, topics=topics, ros_distro="ros2_humble")
    battery, imu, odom = report.topics
    assert "no adapter produces BatteryPack" in battery.excluded
    assert (imu.assumed, odom.assumed) == (
        "sensor_msgs/msg/Imu of ros2_humble",
        "nav_msgs/msg/Odometry of ros2_humble",
    )
    assert differences(DRIVE, out, topics=["/imu", "/odom"]) == {}


def test_export_assumed_type_is_the_one_that_keeps_the_rows(ingested: Ingest, tmp_path: Path) -> None:
    resolver = TypeResolver("ros2_humble")
    messages: list[tuple[str, Any, int, dict[str, Any]]] = []
    point = {"x": 1.0, "y": 2.0, "z": 3.0}
    header = {"stamp": {"sec": 5, "nanosec": 6}, "frame_id": "f"}
    for topic, name, values in (
        ("/plain", "Point", point),
        ("/stamped", "PointStamped", {"header": header, "point": point}),
    ):
        definition = resolver.resolve(f"geometry_msgs/msg/{name}", None, ros_version=2)
        messages.append((topic, definition, 10, values))
    source = record(tmp_path / "in.mcap", messages)
    store = ingested(source)
    with store.catalog.write() as db:
        db.execute("UPDATE topics SET metadata = '{}'")
    out = tmp_path / "out.mcap"
    report = export_sequence(store, "s", out, ros_distro="ros2_humble")
    assert [topic.msgtype for topic in report.topics] == [
        "geometry_msgs/msg/Point",
        "geometry_msgs/msg/PointStamped",
    ]
    assert differences(source, out) == {}


LISTED = {
    "NavSatFix": {"position_covariance", "position_covariance_type", "status.status", "status.service"},
    "Range": {"min_range", "max_range"},
    "Temperature": {"temperature", "variance"},
    "CameraInfo": {"binning_x", "binning_y"},
    "CompressedImage": {"format"},
}
"""What may differ in real recordings, beside `header.seq` and covariances; the documentation has all of it."""


@pytest.mark.slow
def test_export_corpus_recordings_differ_only_in_listed_fields(corpus: Path, tmp_path: Path) -> None:
    with (corpus / "INDEX.tsv").open(encoding="utf-8", newline="") as file:
        paths = [corpus / entry["path"] for entry in csv.DictReader(file, delimiter="\t")]
    compared = 0
    for number, path in enumerate(paths):
        files = [path] if path.is_file() else [one for one in path.rglob("*") if one.is_file()]
        if sum(file.stat().st_size for file in files) < 2_000_000:
            compared += round_trip(path, tmp_path / str(number))
    assert compared > 150


def round_trip(path: Path, folder: Path) -> int:
    """Check one recording; return how many topics were compared."""
    folder.mkdir()
    options = {
        "topics_on_error": TopicLevelErrorPolicy.Ignore,
        "manifest": {"on_error": {"message": "ignore"}},
    }
    reports = run([ROSInjectionConfig(file_path=path, sequence_name="s", store=folder / "s", **options)])
    rejected = {topic.target for topic in reports.recordings[0].topics if topic.rejected}
    try:
        report = export_sequence(Store.open(folder / "s", create=False), "s", folder / "out.mcap")
        actual = differences(path, folder / "out.mcap")
    except IngestError:
        assert reports.recordings[0].totals.written == 0 or reports.recordings[0].error
        return 0
    for topic in report.topics:
        assert not topic.excluded
        assert not topic.changed
        wrong = actual.get(topic.topic, set()) - LISTED.get(topic.msgtype.rpartition("/")[2], set())
        wrong = {field for field in wrong if not field.endswith(("header.seq", "covariance"))}
        assert not wrong or topic.topic in rejected, f"{path}: {topic.topic}: {wrong}"
    return len(report.topics)


PACK = """
float32 volts
uint8[] serial
acme_msgs/Cell[] cells
int16[2] pair
================================================================================
MSG: acme_msgs/Cell
float64 volts
string[] tags
"""
PACK_ADAPTER = """
from mosaico_ingest.adapters.python import ROSAdapterBase
from mosaico_ingest.ontology import Serializable


class Pack(Serializable):
    volts: float
    serial: bytes
    cells: list[float]
    pair: list[int]


class OneWayAdapter(ROSAdapterBase[Pack]):
    ros_msgtype = "acme_msgs/msg/Pack"
    __mosaico_ontology_type__ = Pack

    @classmethod
    def from_dict(cls, ros_data):
        return Pack(**{**ros_data, "cells": [cell["volts"] for cell in ros_data["cells"]]})


class PackAdapter(OneWayAdapter):
    @classmethod
    def to_ros(cls, mosaico_data, typestore, ros_msg_type=None):
        pack, _ = cls.unpack_mosaico_msg(mosaico_data)
        if pack.volts < 0:
            raise ValueError("negative")
        cell = typestore.types["acme_msgs/msg/Cell"]
        cells = [cell(volts=volts, tags=[]) for volts in pack.cells]
        return typestore.types[ros_msg_type](volts=pack.volts, serial=pack.serial, cells=cells, pair=pack.pair)
"""


def record_packs(path: Path, volts: list[float], tags: list[str]) -> Path:
    definition = define("acme_msgs/msg/Pack", PACK)
    cells = [{"volts": 3.5, "tags": tags}, {"volts": 4.0, "tags": []}]
    packs = [{"volts": value, "serial": b"\x00\xff", "cells": cells, "pair": [1, -2]} for value in volts]
    return record(path, [("/pack", definition, at, pack) for at, pack in enumerate(packs)])


def test_export_adapter_in_python_restores_messages_with_to_ros(ingested: Ingest, tmp_path: Path) -> None:
    (tmp_path / "pack.py").write_text(PACK_ADAPTER)
    adapter = f"{tmp_path / 'pack.py'}:PackAdapter"
    source = record_packs(tmp_path / "in.mcap", [1.5, 2.5], [])
    store = ingested(source, adapter_override={"/pack": adapter})
    report = export_sequence(store, "s", tmp_path / "out.mcap", adapters=[adapter])
    assert (report.faithful, report.messages, report.topics[0].adapter) == (True, 2, "PackAdapter")
    assert differences(source, tmp_path / "out.mcap") == {}


def test_export_adapter_in_python_that_fails_names_time_and_reason(ingested: Ingest, tmp_path: Path) -> None:
    (tmp_path / "pack.py").write_text(PACK_ADAPTER)
    adapter = f"{tmp_path / 'pack.py'}:PackAdapter"
    store = ingested(record_packs(tmp_path / "in.mcap", [1.5, -1], []), adapter_override={"/pack": adapter})
    with pytest.raises(AdapterError, match=r"PackAdapter\.to_ros failed at 1 ns: ValueError: negative"):
        export_sequence(store, "s", tmp_path / "out.mcap", adapters=[adapter])
    assert not (tmp_path / "out.mcap").exists()


def test_export_adapter_in_python_without_to_ros_excludes_its_topic(ingested: Ingest, tmp_path: Path) -> None:
    (tmp_path / "pack.py").write_text(PACK_ADAPTER)
    adapter = f"{tmp_path / 'pack.py'}:OneWayAdapter"
    store = ingested(record_packs(tmp_path / "in.mcap", [1.5], []), adapter_override={"/pack": adapter})
    report = export_sequence(store, "s", tmp_path / "out.mcap", adapters=[adapter], dry_run=True)
    assert "override to_ros" in report.topics[0].excluded
