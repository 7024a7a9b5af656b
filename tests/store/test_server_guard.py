"""The audit log, the rate limit, the limits of sizes, and the health check of a server."""

from __future__ import annotations

import json
import os
import stat
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from flight_calls import Client, refused

from mosaico_ingest.cli.app import main
from mosaico_ingest.errors import SinkError
from mosaico_ingest.protocol import key_fingerprint
from mosaico_ingest.protocol.errors import Condition
from mosaico_ingest.protocol.messages import Permission
from mosaico_ingest.serve import Keyring, Limits, responds, serve

Rows = Callable[..., pa.RecordBatch]


def entries(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_audit_log_records_key_call_target_and_status(tmp_path: Path, rows: Rows) -> None:
    ring = Keyring(tmp_path / "keys.json")
    key, other = ring.add(Permission.WRITE), ring.add(Permission.READ)
    log = tmp_path / "audit.jsonl"
    with serve(tmp_path / "served", port=0, keys=ring, audit_log=log) as running:
        with Client(running, key) as writer:
            writer.call("sequence_create", locator="drive", user_metadata={})
            writer.upload("drive", "/imu", rows([1, 2, 3]))
        with Client(running, other) as reader:
            reader.rows("drive/imu")
            with refused(Condition.PERMISSION):
                reader.call("sequence_delete", locator="drive")
        with Client(running) as stranger, refused(Condition.UNAUTHENTICATED):
            stranger.call("version")
    calls = [(one["call"], one["target"], one["rows"]) for one in entries(log)[:-1]]
    assert calls[:2] + calls[3:4] + calls[5:] == [
        ("sequence_create", "drive", None),
        ("session_create", "drive", None),
        ("put", "drive/imu", 3),
        ("get_flight_info", "drive/imu", None),
        ("get", "drive/imu", None),
        ("sequence_delete", "", None),
    ]
    callers = [one["key"] for one in entries(log)]
    assert callers == [key_fingerprint(key)] * 5 + [key_fingerprint(other)] * 3 + [None]
    statuses = [one["status"] for one in entries(log)]
    assert statuses[:-2] == ["ok"] * 7
    assert "permission denied" in statuses[-2]
    assert "requires an API key" in statuses[-1]
    assert entries(log)[3]["bytes"] > 3 * 8
    assert entries(log)[0]["peer"].startswith("ipv4:127.0.0.1:")
    assert key not in log.read_text()
    if os.name == "posix":
        assert stat.S_IMODE(log.stat().st_mode) == 0o600


def test_audit_log_line_contains_no_control_characters(tmp_path: Path) -> None:
    log = tmp_path / "audit.jsonl"
    with (
        serve(tmp_path / "served", port=0, audit_log=log) as running,
        Client(running) as client,
        refused(Condition.INVALID),
    ):
        client.call("sequence_delete", locator="a\nb\x1b[31m\u2028")
    assert [one["target"] for one in entries(log)] == ["a\nb\x1b[31m\u2028"]
    assert log.read_bytes().count(b"\n") == 1
    assert b"\x1b" not in log.read_bytes()


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has /dev/full")
def test_call_that_cannot_be_recorded_is_refused(tmp_path: Path) -> None:
    with (
        serve(tmp_path / "served", port=0, audit_log=Path("/dev/full")) as running,
        Client(running) as client,
        refused(Condition.UNAVAILABLE, "audit log"),
    ):
        client.call("version")


def test_audit_log_in_missing_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(SinkError, match="audit log"):
        serve(tmp_path / "served", port=0, audit_log=tmp_path / "absent" / "audit.jsonl")


def test_calls_above_the_rate_of_a_key_are_refused_and_others_accepted(tmp_path: Path) -> None:
    ring = Keyring(tmp_path / "keys.json")
    keys = [ring.add(Permission.READ), ring.add(Permission.READ)]
    limits = Limits(requests_per_s=0.2)  # two calls immediately, then one in five seconds
    with (
        serve(tmp_path / "served", port=0, keys=ring, limits=limits) as running,
        Client(running, keys[0]) as first,
        Client(running, keys[1]) as second,
    ):
        first.call("version")
        first.call("version")
        with refused(Condition.UNAVAILABLE, "0.2 calls per second"):
            first.call("version")
        second.call("version")


def test_calls_without_keys_share_the_rate_of_their_address(tmp_path: Path) -> None:
    with serve(tmp_path / "served", port=0, limits=Limits(requests_per_s=0.1)) as running:
        with Client(running) as first:
            first.call("version")
        with Client(running) as second, refused(Condition.UNAVAILABLE, "calls per second"):
            second.call("version")


def test_request_above_the_limit_is_refused(tmp_path: Path) -> None:
    with (
        serve(tmp_path / "served", port=0, limits=Limits(request_bytes=1000)) as running,
        Client(running) as client,
    ):
        client.call("sequence_create", locator="drive", user_metadata={"a": "x" * 500})
        with refused(Condition.INVALID, "accepts 1000"):
            client.call("sequence_create", locator="other", user_metadata={"a": "x" * 1000})


@pytest.mark.parametrize(
    ("limits", "word"),
    [(Limits(request_bytes=5000), "accepts 5000"), (Limits(upload_bytes=5000), "more than 5000 bytes")],
)
def test_upload_above_the_limit_is_refused_and_not_stored(
    tmp_path: Path, rows: Rows, limits: Limits, word: str
) -> None:
    with serve(tmp_path / "served", port=0, limits=limits) as running, Client(running) as client:
        client.call("sequence_create", locator="drive", user_metadata={})
        client.upload("drive", "/small", rows([1]))
        session = client.call("session_create", locator="drive")["uuid"]
        uuid = client.create_topic(session, "drive/large")
        with refused(Condition.INVALID, word):
            client.put("drive/large", uuid, rows(range(100)), rows(range(100, 1000)))
        with refused(Condition.PRECONDITION):
            client.call("session_finalize", session_uuid=session)
        assert [topic["resource_locator"] for topic in client.info("drive")[1] if topic["locked"]] == [
            "drive/small"
        ]


def test_health_check_tells_whether_a_server_responds(tmp_path: Path) -> None:
    with serve(tmp_path / "served", port=0, keys=Keyring(tmp_path / "keys.json")) as running:
        port = str(running.port)
        assert responds(running.location)
        with pytest.raises(SystemExit) as healthy:
            main(["serve", "--health-check", "--host", "0.0.0.0", "--port", port])  # noqa: S104 - not bound
    assert healthy.value.code == 0
    with pytest.raises(SystemExit) as unhealthy:
        main(["serve", "--health-check", "--port", port])
    assert unhealthy.value.code == 1
