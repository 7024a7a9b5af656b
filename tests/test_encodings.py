"""Recordings with protobuf, JSON and other encodings, from the file to the store and back."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from foxglove_schemas import MESSAGES, json_definition, json_payload, protobuf_definition, protobuf_payload
from protobuf_schemas import definition_of, message_class, proto3_file

from mosaico_ingest import ROSInjectionConfig, ROSLoader
from mosaico_ingest.adapters.builtin import BY_TYPE
from mosaico_ingest.api import inspect_recording, run
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import IngestError, NothingMatched
from mosaico_ingest.export import export_sequence
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded
from mosaico_ingest.rosbag.encodings.json_schema import read_schema
from mosaico_ingest.rosbag.mcap.index import text_bytes
from mosaico_ingest.rosbag.mcap.writer import McapWriter

START_NS = 1_700_000_000_000_000_000
Sent = tuple[str, Definition, Sequence[bytes]]


def write(path: Path, *topics: Sent) -> Path:
    writer = McapWriter(path)
    for topic, definition, payloads in topics:
        connection = writer.add_connection(topic, definition, embed=bool(definition.text))
        for number, payload in enumerate(payloads):
            writer.write(connection, START_NS + number, payload)
    writer.finish()
    return path


def write_raw(path: Path, encoding: str, schema: tuple[str, str, bytes], payloads: list[bytes]) -> Path:
    """Write a recording without an index, with any encodings."""
    record = struct.Struct("<BQ")

    def framed(op: int, content: bytes) -> bytes:
        return record.pack(op, len(content)) + content

    name, schema_encoding, text = schema
    head = struct.pack("<H", 1) + text_bytes(name) + text_bytes(schema_encoding)
    channel = struct.pack("<HH", 1, 1) + text_bytes("/t") + text_bytes(encoding) + struct.pack("<I", 0)
    parts = [
        framed(1, text_bytes("") + text_bytes("test")),
        framed(3, head + struct.pack("<I", len(text)) + text),
        framed(4, channel),
        *(
            framed(5, struct.pack("<HIQQ", 1, number, START_NS + number, START_NS) + payload)
            for number, payload in enumerate(payloads)
        ),
        framed(15, struct.pack("<I", 0)),
        framed(2, struct.pack("<QQI", 0, 0, 0)),
    ]
    magic = b"\x89MCAP0\r\n"
    path.write_bytes(magic + b"".join(parts) + magic)
    return path


@pytest.fixture
def ingest(tmp_path: Path) -> Callable[..., Any]:
    def run_job(path: Path, **settings: Any) -> Any:
        name = settings.pop("sequence_name", "s")
        config = ROSInjectionConfig(
            file_path=path, sequence_name=name, store=str(tmp_path / "store"), **settings
        )
        return run([config])

    return run_job


def rows_of(folder: Path, topic: str, sequence: str = "s") -> list[dict[str, Any]]:
    with Store.open(folder / "store").scan(sequence, topic) as reader:
        return reader.read_all().to_pylist()


SCHEMA = {
    "title": "Speed",
    "type": "object",
    "properties": {"v": {"type": "number", "minimum": 0}, "note": {"type": "string"}},
    "required": ["v"],
}
SPEED = read_schema("Speed", Embedded("jsonschema", json.dumps(SCHEMA)))
FREE = read_schema("", None)


def test_foxglove_protobuf_and_json_topics_are_stored_equally(tmp_path: Path, ingest: Any) -> None:
    topics = [
        (f"/{form}/{name}", define(name), [payload(name, message)] * 9)
        for name, message in MESSAGES.items()
        for form, define, payload in (
            ("pb", protobuf_definition, protobuf_payload),
            ("js", json_definition, lambda _, message: json_payload(message)),
        )
    ]
    report = ingest(write(tmp_path / "r.mcap", *topics))
    assert (report.recordings[0].totals.written, report.recordings[0].totals.rejected) == (9 * len(topics), 0)
    for name in MESSAGES:
        if f"foxglove.{name}" in BY_TYPE:
            assert rows_of(tmp_path, f"/pb/{name}") == rows_of(tmp_path, f"/js/{name}")


@pytest.mark.parametrize(
    "names",
    [["Log"], ["PoseInFrame", "FrameTransforms", "CompressedImage", "PosesInFrame"]],
    ids=["unmodeled", "adapted"],
)
def test_export_restores_protobuf_and_json_recordings(tmp_path: Path, ingest: Any, names: list[str]) -> None:
    topics = [
        *(
            (f"/pb/{name}", protobuf_definition(name), [protobuf_payload(name, MESSAGES[name])] * 6)
            for name in names
        ),
        *((f"/js/{name}", json_definition(name), [json_payload(MESSAGES[name])] * 6) for name in names),
    ]
    source = write(tmp_path / "r.mcap", *topics)
    ingest(source)
    report = export_sequence(Store.open(tmp_path / "store"), "s", tmp_path / "again.mcap")
    assert report.faithful
    before, after = (
        sorted(repr((one.topic, one.timestamp_ns, one.msg_type, one.data)) for one, _ in ROSLoader(path))
        for path in (source, tmp_path / "again.mcap")
    )
    assert before == after
    definitions = [
        {
            topic.topic: (topic.msgtype, topic.encoding, topic.definition)
            for topic in inspect_recording(path).topics
        }
        for path in (source, tmp_path / "again.mcap")
    ]
    assert definitions[0] == definitions[1]
    ingest(tmp_path / "again.mcap", sequence_name="again")
    for topic, _, _ in topics:
        assert rows_of(tmp_path, topic, "again") == rows_of(tmp_path, topic)


def test_export_keeps_absent_fields_absent(tmp_path: Path, ingest: Any) -> None:
    kind = message_class(proto3_file(), "all.Message")
    messages = [
        kind(),
        kind(maybe_int32=0, inner={}),
        kind(int_choice=3, wrapped={"value": 1.5}, inners=[{}]),
        kind(),
    ]
    source = write(
        tmp_path / "r.mcap",
        ("/pb", definition_of(proto3_file(), "all.Message"), [one.SerializeToString() for one in messages]),
        ("/js", SPEED, [b'{"v":1.0}', b'{"v":1.0,"note":"a"}', b'{"v":2.0}']),
        ("/free", FREE, [b'{"a":1}', b'{"a":2.5,"b":[1]}', b'{"c":{"d":null}}']),
    )
    ingest(source)
    assert export_sequence(Store.open(tmp_path / "store"), "s", tmp_path / "again.mcap").faithful
    before, after = (
        sorted(repr((one.topic, one.timestamp_ns, one.data)) for one, _ in ROSLoader(path))
        for path in (source, tmp_path / "again.mcap")
    )
    assert before == after


def test_export_of_protobuf_to_rosbag_is_refused(tmp_path: Path, ingest: Any) -> None:
    ingest(
        write(
            tmp_path / "r.mcap",
            ("/a", protobuf_definition("Log"), [protobuf_payload("Log", MESSAGES["Log"])]),
        )
    )
    store = Store.open(tmp_path / "store")
    with pytest.raises(IngestError, match=r"write \.mcap"):
        export_sequence(store, "s", tmp_path / "again.db3")


def test_invalid_messages_are_rejected_with_rule_and_reason(tmp_path: Path, ingest: Any) -> None:
    good = protobuf_payload("Log", MESSAGES["Log"])
    source = write(
        tmp_path / "r.mcap",
        ("/pb", protobuf_definition("Log"), [*[good] * 6, b"\xff"]),
        ("/js", SPEED, [*[b'{"v": 1}'] * 6, b'{"v": -1}', b"{}", b"no"]),
    )
    report = ingest(source, topics_on_error="ignore")
    rejected = {
        (topic.topic, one.rule): (one.count, one.reason)
        for topic in report.recordings[0].topics
        for one in topic.rejections
    }
    assert {key: count for key, (count, _) in rejected.items()} == {
        ("/pb", "protobuf"): 1,
        ("/js", "json-schema"): 2,
        ("/js", "json-syntax"): 1,
    }
    assert rejected["/js", "json-schema"][1] == "$.v: -1 is less than the minimum of 0 (minimum)"


def test_undeclared_json_fields_are_a_finding(tmp_path: Path, ingest: Any) -> None:
    source = write(tmp_path / "r.mcap", ("/js", SPEED, [b'{"v": 1, "w": {"x": 1}}'] * 6))
    report = ingest(source)
    assert any("undeclared-fields" in finding for finding in report.recordings[0].findings)
    assert rows_of(tmp_path, "/js") == [
        {"timestamp_ns": START_NS + n, "v": 1.0, "note": None} for n in range(6)
    ]


def test_json_without_schema_has_the_fields_of_all_messages(tmp_path: Path, ingest: Any) -> None:
    payloads = [
        b'{"a": 1}',
        b'{"a": 1.5, "b": {"c": "x"}}',
        b'{"b": {"d": [1, 2]}}',
        b'{"e": 1}',
        b'{"e": "text"}',
    ]
    report = ingest(write(tmp_path / "r.mcap", ("/free", FREE, payloads)))
    assert report.recordings[0].totals.rejected == 0
    rows = rows_of(tmp_path, "/free")
    assert [row["a"] for row in rows] == [1.0, 1.5, None, None, None]
    assert rows[2]["b"] == {"c": None, "d": [1, 2]}
    assert [row["e"] for row in rows[3:]] == ["1", '"text"']


def test_built_in_adapter_that_does_not_fit_keeps_the_shape(tmp_path: Path, ingest: Any) -> None:
    schema = {"type": "object", "properties": {"angular": {"type": "string"}}}
    definition = read_schema("sensor_msgs/Imu", Embedded("jsonschema", json.dumps(schema)))
    report = ingest(write(tmp_path / "r.mcap", ("/imu", definition, [b'{"angular": "x"}'] * 6)))
    assert [topic.ontology for topic in report.recordings[0].topics] == ["Imu"]
    assert rows_of(tmp_path, "/imu")[0]["angular"] == "x"


def test_adapter_file_takes_json_type(tmp_path: Path, ingest: Any) -> None:
    adapter = tmp_path / "speed.yaml"
    adapter.write_text(
        "version: 1\nadapter: SpeedAdapter\nros_type: Speed\nontology: Floating64\nfields: {data: v}\n"
    )
    report = ingest(
        write(tmp_path / "r.mcap", ("/js", SPEED, [b'{"v": 2}'] * 6)),
        manifest={"adapters": {"load": [str(adapter)]}},
    )
    assert [(topic.adapter, topic.written) for topic in report.recordings[0].topics] == [("SpeedAdapter", 6)]


@pytest.mark.parametrize("name", ["cbor", "flatbuffer"])
def test_other_encodings_are_refused_by_name(tmp_path: Path, ingest: Any, name: str) -> None:
    path = write_raw(tmp_path / "r.mcap", name, ("T", name, b""), [b"\xa0"])
    inspection = inspect_recording(path)
    assert inspection.topics[0].problem is not None
    assert f"{name!r}" in inspection.topics[0].problem
    assert any("skipped-encoding" in finding for finding in inspection.findings)
    assert ingest(path).exit_code == NothingMatched.exit_code


@pytest.mark.parametrize("schema_encoding", ["ros2idl", "omgidl"])
def test_cdr_messages_with_idl_schemas_are_stored(tmp_path: Path, ingest: Any, schema_encoding: str) -> None:
    idl = b"module acme { module msg { struct Speed { double v; unsigned long n; }; }; };"
    payload = b"\x00\x01\x00\x00" + struct.pack("<dI", 1.5, 7)
    ingest(write_raw(tmp_path / "r.mcap", "cdr", ("acme/msg/Speed", schema_encoding, idl), [payload] * 3))
    assert rows_of(tmp_path, "/t")[0] == {"timestamp_ns": START_NS, "v": 1.5, "n": 7}


def test_ros1_messages_are_stored(tmp_path: Path, ingest: Any) -> None:
    payload = struct.pack("<dI", 1.5, 7)
    ingest(
        write_raw(
            tmp_path / "r.mcap", "ros1", ("acme/Speed", "ros1msg", b"float64 v\nuint32 n\n"), [payload] * 3
        )
    )
    assert rows_of(tmp_path, "/t")[0] == {"timestamp_ns": START_NS, "v": 1.5, "n": 7}


def test_protobuf_channel_without_schema_states_the_reason(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "r.mcap", "protobuf", ("T", "", b""), [b"\x08\x01"])
    assert "it needs a FileDescriptorSet" in str(inspect_recording(path).topics[0].problem)


def test_quarantined_messages_keep_their_schema(tmp_path: Path, ingest: Any) -> None:
    source = write(tmp_path / "r.mcap", ("/js", SPEED, [*[b'{"v": 1}'] * 6, b'{"v": -1}']))
    ingest(source, manifest={"quarantine": {"path": str(tmp_path / "q")}})
    kept = next((tmp_path / "q").rglob("*.mcap"))
    topic = inspect_recording(kept).topics[0]
    assert (topic.msgtype, topic.encoding, topic.count) == ("Speed", "json", 1)
