"""Content of recordings, besides messages, that sequences keep: metadata records, custom_data and attachments."""

from __future__ import annotations

import json
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.records import Attachment
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2
from rosbags.typesys import Stores, get_typestore

from mosaico_ingest import api, inspect
from mosaico_ingest.cli.app import main
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.destinations.store.store import verify_attachments
from mosaico_ingest.export import export_sequence
from mosaico_ingest.job.values import ATTACHMENTS_KEY, CUSTOM_DATA_KEY, RECORDS_KEY, IfExists
from mosaico_ingest.pages.sequence import sequence_page
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.recording import open_recording

CALIBRATION = bytes(range(256)) * 40_000
"""Content that is larger than one read."""


def write_mcap(path: Path, *, indexed: bool = True, plain: bytes = b"") -> Path:
    """Write a recording with one message, two metadata records and two attachments."""
    with path.open("wb") as file:
        writer = Writer(
            file,
            compression=CompressionType.NONE,
            index_types=IndexType.ALL if indexed else IndexType.CHUNK | IndexType.MESSAGE,
        )
        writer.start(profile="", library="test")
        schema = {"type": "object", "properties": {"a": {"type": "number"}}}
        number = writer.register_schema("acme.T", "jsonschema", json.dumps(schema).encode())
        channel = writer.register_channel("/a", "json", number)
        writer.add_metadata("vehicle.info", {"id": "r1", "weird.key$": "ü"})
        writer.add_metadata("empty", {})
        writer.add_attachment(5, 7, "calib/cam 0.yaml", "text/yaml", CALIBRATION)
        writer.add_message(channel, 10**9, b'{"a": 1}', 10**9)
        writer.add_attachment(0, 9, "empty.bin", "", plain)
        writer.finish()
    return path


def ingest(path: Path, **keys: Any) -> tuple[Any, Store]:
    job = path.parent / "job.yaml"
    job.write_text(json.dumps({"bag": {"path": path.name}, "target": {"store": "store"}, **keys}))
    (report,) = api.run(job).recordings
    return report, Store.open(path.parent / "store")


def attachments(path: Path) -> list[Attachment]:
    with path.open("rb") as file:
        return list(make_reader(file, validate_crcs=True).iter_attachments())


def records(path: Path) -> dict[str, Mapping[str, str]]:
    with path.open("rb") as file:
        return {record.name: record.metadata for record in make_reader(file).iter_metadata()}


@pytest.mark.parametrize("indexed", [True, False])
def test_attachments_and_records_round_trip_through_store(tmp_path: Path, *, indexed: bool) -> None:
    original = write_mcap(tmp_path / "drive.mcap", indexed=indexed)
    _, store = ingest(original)
    info = store.sequence("drive")
    assert info.metadata[RECORDS_KEY] == [
        {"name": "vehicle.info", "entries": [["id", "r1"], ["weird.key$", "ü"]]},
        {"name": "empty", "entries": []},
    ]
    assert [(each.name, each.stored_bytes) for each in info.attachments] == [
        ("calib/cam 0.yaml", len(CALIBRATION)),
        ("empty.bin", 0),
    ]
    assert [each.problem for each in verify_attachments(info)] == [None, None]
    report = export_sequence(store, "drive", tmp_path / "again.mcap")
    assert report.faithful
    written = write_mcap(tmp_path / "indexed.mcap")
    assert attachments(tmp_path / "again.mcap") == attachments(written)
    assert records(tmp_path / "again.mcap") == records(written)


def test_attachments_of_truncated_recording_are_kept(tmp_path: Path) -> None:
    original = write_mcap(tmp_path / "drive.mcap")
    original.write_bytes(original.read_bytes()[:-40])
    _, store = ingest(original)
    assert [each.name for each in store.sequence("drive").attachments] == ["calib/cam 0.yaml", "empty.bin"]


def test_damaged_attachment_is_reported_and_not_stored(tmp_path: Path) -> None:
    original = write_mcap(tmp_path / "drive.mcap", plain=b"hello attachment")
    original.write_bytes(original.read_bytes().replace(b"hello attachment", b"jello attachment"))
    report, store = ingest(original)
    assert ["[damaged-record]" in finding for finding in report.findings] == [True]
    assert [each.name for each in store.sequence("drive").attachments] == ["calib/cam 0.yaml"]
    files = [path for path in (tmp_path / "store" / "attachments").rglob("*") if path.is_file()]
    assert len(files) == 1


@pytest.mark.parametrize("indexed", [True, False])
def test_damaged_records_are_reported_by_inspect_plan_and_run(tmp_path: Path, *, indexed: bool) -> None:
    """The sizes of a text in a metadata record and in an attachment exceed their records."""
    original = write_mcap(tmp_path / "drive.mcap", indexed=indexed)
    content = original.read_bytes()
    name = len(b"vehicle.info").to_bytes(4, "little") + b"vehicle.info"
    media_type = len(b"text/yaml").to_bytes(4, "little") + b"text/yaml"
    for field in (name, media_type):
        content = content.replace(field, b"\xff\xff\xff\x7f" + field[4:], 1)
    original.write_bytes(content)
    expected = [
        f"the metadata record at {content.index(b'vehicle.info') - 13} cannot be read",
        f"the attachment at {content.index(b'calib/cam 0.yaml') - 29} cannot be read",
    ]
    report, store = ingest(original)
    (plan,) = api.plan_job(tmp_path / "job.yaml").recordings
    notes = [f"{note.severity.value}[{note.rule}] {note.message}" for note in plan.notes]
    for findings in (report.findings, inspect(original).findings, notes):
        damaged = [finding for finding in findings if finding.startswith("warning[damaged-record]")]
        assert [text in finding for text, finding in zip(expected, damaged, strict=True)] == [True, True]
    info = store.sequence("drive")
    assert [each.name for each in info.attachments] == ["empty.bin"]
    assert [record["name"] for record in info.metadata[RECORDS_KEY]] == ["empty"]


def test_keep_settings_select_records_and_attachments(tmp_path: Path) -> None:
    keep = {"records": ["e*"], "attachments": []}
    _, store = ingest(write_mcap(tmp_path / "drive.mcap"), sequence={"name": "s", "keep": keep})
    info = store.sequence("s")
    assert info.metadata[RECORDS_KEY] == [{"name": "empty", "entries": []}]
    assert info.attachments == ()


def command(*arguments: str) -> object:
    """Run a command and return its exit code."""
    with pytest.raises(SystemExit) as leave:
        main(list(arguments))
    return leave.value.code or 0


def test_describe_and_page_list_attachments(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, store = ingest(write_mcap(tmp_path / "drive.mcap"))
    files = [str(each.path) for each in store.sequence("drive").attachments]
    assert command("store", "describe", "drive", "--store", str(tmp_path / "store"), "--json") == 0
    described = json.loads(capsys.readouterr().out)["attachments"]
    assert [(each["name"], each["file"]) for each in described] == list(
        zip(["calib/cam 0.yaml", "empty.bin"], files, strict=True)
    )
    assert command("store", "describe", "drive", "--store", str(tmp_path / "store")) == 0
    assert "calib/cam 0.yaml" in capsys.readouterr().out
    page = sequence_page(store, "drive")
    assert all(escape(file) in page for file in files)
    assert ATTACHMENTS_KEY not in page


def test_verify_reports_changed_and_missing_attachments(tmp_path: Path) -> None:
    _, store = ingest(write_mcap(tmp_path / "drive.mcap"))
    first, second = store.sequence("drive").attachments
    Path(str(first.path)).write_bytes(b"changed")
    Path(str(second.path)).unlink()
    assert command("verify", "drive", "--store", str(tmp_path / "store")) == 5
    problems = [each.problem for each in verify_attachments(store.sequence("drive"))]
    assert [problem is None for problem in problems] == [False, False]


def test_replace_delete_and_garbage_collection_remove_attachments(tmp_path: Path) -> None:
    original = write_mcap(tmp_path / "drive.mcap")
    _, store = ingest(original)
    (before, _) = store.sequence("drive").attachments
    ingest(original, sequence={"if_exists": IfExists.REPLACE.value})
    (after, _) = store.sequence("drive").attachments
    assert not before.path.exists()
    orphan = Path(str(after.path)).with_name("01ORPHAN-0000-x")
    orphan.write_bytes(b"x")
    assert store.collect_garbage(grace_s=0).files == 1
    assert after.path.exists()
    store.delete_sequence("drive")
    assert list((tmp_path / "store" / "attachments").rglob("*")) == []


def test_show_lists_attachments_without_their_metadata_key(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ingest(write_mcap(tmp_path / "drive.mcap"))
    arguments = ["store", "show", "drive", "--store", str(tmp_path / "store")]
    capsys.readouterr()
    assert command(*arguments) == 0
    text = capsys.readouterr().out
    assert "calib/cam 0.yaml" in text
    assert "_attachments_:" not in text
    command(*arguments, "--json")
    (first, _) = json.loads(capsys.readouterr().out)["attachments"]
    assert (first["name"], first["log_ns"], first["create_ns"]) == ("calib/cam 0.yaml", 7, 5)


def test_server_destination_reports_attachments_that_it_cannot_store(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "drive.mcap")
    job = tmp_path / "job.yaml"
    job.write_text(json.dumps({"bag": {"path": path.name}, "target": {"host": "localhost", "port": 1}}))
    (recording,) = api.plan_job(job).recordings
    assert "attachments-not-stored" in {note.rule for note in recording.notes}


@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
def test_custom_data_round_trips_through_store(tmp_path: Path, suffix: str) -> None:
    typestore = get_typestore(Stores.ROS2_HUMBLE)
    with Rosbag2(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.set_custom_data("driver", "Ada")
        connection = writer.add_connection("/a", "std_msgs/msg/Int32", typestore=typestore)
        message = typestore.types["std_msgs/msg/Int32"](data=1)
        writer.write(connection, 10**9, typestore.serialize_cdr(message, "std_msgs/msg/Int32"))
    _, store = ingest(tmp_path / "bag")
    assert store.sequence("bag").metadata[CUSTOM_DATA_KEY] == [["driver", "Ada"]]
    again = tmp_path / f"again{suffix}"
    assert export_sequence(store, "bag", again).faithful
    with open_recording(again, resolve=TypeResolver(None)) as recording:
        assert recording.custom_data() == {"driver": "Ada"}


def test_export_to_bag_reports_omitted_content(tmp_path: Path) -> None:
    original = tmp_path / "drive.mcap"
    with original.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros1", library="test")
        schema = writer.register_schema("std_msgs/Int32", "ros1msg", b"int32 data")
        channel = writer.register_channel("/a", "ros1", schema)
        writer.add_message(channel, 10**9, bytes(4), 10**9)
        writer.add_metadata("vehicle", {"id": "r1"})
        writer.add_attachment(5, 7, "a.txt", "text/plain", b"x")
        writer.finish()
    _, store = ingest(original)
    report = export_sequence(store, "drive", tmp_path / "again.bag")
    assert report.omitted == ("metadata records: vehicle", "attachments: a.txt")
    assert not report.faithful
