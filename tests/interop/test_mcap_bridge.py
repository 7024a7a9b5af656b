"""The official SDK's MCAP bridge and this package store the same values of protobuf and JSON messages."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from foxglove_schemas import MESSAGES, json_definition, json_payload, protobuf_definition, protobuf_payload
from protobuf_schemas import definition_of, message_class, proto3_file

from mosaico_ingest.api import RosbagInjector
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded
from mosaico_ingest.rosbag.encodings.json_schema import read_schema
from mosaico_ingest.rosbag.mcap.writer import McapWriter
from mosaico_ingest.serve import Server, serve

pytestmark = pytest.mark.interop
pytest.importorskip(
    "mosaicolabs.bridges.mcap", reason="the official SDK has no MCAP bridge, or is not installed"
)

START_NS = 1_700_000_000_000_000_000
ONLY_SDK = "publish_time_ns"
"""A column of the SDK; recordings are read by log time only."""
SCHEMA = {
    "title": "Plain",
    "type": "object",
    "properties": {
        "count": {"type": "integer"},
        "speed": {"type": "number"},
        "name": {"type": "string"},
        "on": {"type": "boolean"},
        "inner": {"type": "object", "properties": {"x": {"type": "number"}}},
        "values": {"type": "array", "items": {"type": "number"}},
    },
}
PLAIN = read_schema("Plain", Embedded("jsonschema", json.dumps(SCHEMA)))
PLAIN_ROWS = [
    {"count": n, "speed": n / 3, "name": f"é{n}", "on": n % 2 == 0, "inner": {"x": 1.5}, "values": [0.5] * n}
    for n in range(9)
]
UNMODELED = "Log"
"""The Foxglove type that no default adapter converts."""


_REFUSED = {"free", "tree", "wrapped", "wrapped_texts", "nothing"}
"""Fields that the SDK cannot upload: `Struct`, recursive messages, wrappers, and messages without fields."""


def _plain_file() -> Any:
    """Return the file of all features except the fields that the SDK cannot upload."""
    file = proto3_file()
    message = next(one for one in file.message_type if one.name == "Message")
    kept = [field for field in message.field if field.name not in _REFUSED]
    del message.field[:]
    message.field.extend(kept)
    return file


def _messages() -> list[bytes]:
    kind = message_class(_plain_file(), "all.Message")
    return [
        kind(last=n, one_int64=2**40 + n, many_double=[0.1, 0.2], one_bytes=b"\xff", inner={"x": 1.5},
             inners=[{"label": "a"}], one_color=2, stamp={"seconds": 5, "nanos": 6}, text_choice="t",
             maybe_int32=0, one_string="é")
        if n % 2
        else kind(int_choice=n, unpacked=[1, 2])
        for n in range(8)
    ]  # fmt: skip


def _write(path: Path, topics: list[tuple[str, Definition, list[bytes]]]) -> None:
    writer = McapWriter(path)
    for topic, definition, payloads in topics:
        connection = writer.add_connection(topic, definition)
        for number, payload in enumerate(payloads):
            writer.write(connection, START_NS + number, payload)
    writer.finish()


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("mcap")
    recording = folder / "r.mcap"
    _write(
        recording,
        [
            (
                "/all",
                definition_of(_plain_file(), "all.Message"),
                [one.SerializeToString() for one in _messages()],
            ),
            ("/plain", PLAIN, [json.dumps(row).encode() for row in PLAIN_ROWS]),
            (
                "/log_pb",
                protobuf_definition(UNMODELED),
                [protobuf_payload(UNMODELED, MESSAGES[UNMODELED])] * 3,
            ),
            ("/log_js", json_definition(UNMODELED), [json_payload(MESSAGES[UNMODELED])] * 3),
        ],
    )
    with serve(folder / "store", port=0) as server:
        RosbagInjector(ROSInjectionConfig(recording, "ours", store=server.store_path)).run()
        injector = Path(sys.executable).with_name("mosaicolabs.mcap_injector")
        command = [str(injector), str(recording), "--name", "theirs", "--host", "127.0.0.1"]
        command += ["--port", str(server.port)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - the SDK's own command
        assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
        yield server


def _plain(value: Any) -> Any:
    """Return a value in a form that does not depend on how maps and wrapped values are stored."""
    if isinstance(value, dict):
        if value.keys() == {"value"}:
            return _plain(value["value"])
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        pairs = value and all(isinstance(one, tuple) and len(one) == 2 for one in value)
        return (
            [{"key": key, "value": _plain(one)} for key, one in value]
            if pairs
            else [_plain(one) for one in value]
        )
    return value


@pytest.mark.parametrize("topic", ["/all", "/plain", "/log_pb", "/log_js"])
def test_rows_of_unmodeled_messages_equal_those_of_the_sdk(served: Server, topic: str) -> None:
    store = Store.open(served.store_path)
    rows = [store.scan(sequence, topic).read_all().to_pylist() for sequence in ("ours", "theirs")]
    for row in rows[1]:
        del row[ONLY_SDK]
    ours, theirs = (_plain(one) for one in rows)
    assert ours
    assert ours == theirs


@pytest.mark.parametrize("topic", ["/all", "/plain"])
def test_metadata_has_the_schema_as_the_sdk_stores_it(served: Server, topic: str) -> None:
    store = Store.open(served.store_path)
    blocks = [
        next(one for one in store.sequence(name).topics if one.name == topic).metadata["_mcap_"]
        for name in ("ours", "theirs")
    ]
    shared = blocks[0].keys() & blocks[1].keys()
    assert shared >= {"channel_name", "channel_encoding", "schema_name", "schema_encoding", "schema_def"}
    assert {key: blocks[0][key] for key in shared} == {key: blocks[1][key] for key in shared}
