"""Access to a server: API keys, permissions and TLS."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path

import pyarrow as pa
import pyarrow.flight as fl
import pytest
from flight_calls import Client, refused

from mosaico_ingest.errors import SinkError
from mosaico_ingest.protocol.errors import Condition
from mosaico_ingest.protocol.messages import ACTIONS, Permission
from mosaico_ingest.serve import Keyring, Tls, serve

Rows = Callable[..., pa.RecordBatch]


@pytest.mark.promise("write-permission")
def test_key_permits_only_actions_of_its_permission(tmp_path: Path, rows: Rows) -> None:
    ring = Keyring(tmp_path / "keys.json")
    keys = {permission: ring.add(permission) for permission in Permission}
    with serve(tmp_path / "served", port=0, keys=Keyring(tmp_path / "keys.json")) as running:
        with Client(running, keys[Permission.WRITE]) as writer:
            writer.call("info")
            writer.call("sequence_create", locator="drive", user_metadata={})
            writer.upload("drive", "/imu", rows([1]))
            with refused(Condition.PERMISSION, "delete"):
                writer.call("sequence_delete", locator="drive")
        with Client(running, keys[Permission.READ]) as reader:
            assert reader.rows("drive/imu") == [1]
            assert len(list(reader.flight.list_flights(options=reader.options))) == 1
            with refused(Condition.PERMISSION, "write"):
                reader.call("session_create", locator="drive")
            with refused(Condition.PERMISSION, "write"):
                reader.put("drive/imu", "x", rows([1]))
        with Client(running, keys[Permission.MANAGE]) as manager:
            manager.call("sequence_delete", locator="drive")


@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (lambda _: None, "requires an API key"),
        (lambda _: "secret", "malformed"),
        (lambda key: key[:-1] + ("0" if key[-1] != "0" else "1"), "checksum"),
        (lambda _: "msco_" + "a" * 32 + "_d25389d7", "malformed"),
    ],
    ids=["none", "no key at all", "a typing mistake", "somebody else's"],
)
def test_call_without_valid_key_is_unauthenticated(
    tmp_path: Path, spoil: Callable[[str], str | None], word: str
) -> None:
    ring = Keyring(tmp_path / "keys.json")
    key = spoil(ring.add(Permission.MANAGE))
    with serve(tmp_path / "served", port=0, keys=ring) as running, Client(running, key) as client:
        for name in ACTIONS:
            with refused(Condition.UNAUTHENTICATED, word):
                client.call(name)
        with refused(Condition.UNAUTHENTICATED, word):
            list(client.flight.list_flights(options=client.options))
        with refused(Condition.UNAUTHENTICATED, word):
            client.info("drive")


def test_keyring_stores_hashes_and_refuses_expired_key(tmp_path: Path) -> None:
    path = tmp_path / "keys.json"
    now = datetime.now(timezone.utc)
    good = Keyring(path).add(Permission.READ, description="dashboard", expires=now + timedelta(days=1))
    old = Keyring(path).add(Permission.READ, expires=now - timedelta(days=1))
    ring = Keyring(path)
    assert ring.permission_of(good) is Permission.READ
    with pytest.raises(PermissionError, match="expired on"):
        ring.permission_of(old)
    assert [key.description for key in ring.keys] == ["dashboard", ""]
    assert good not in path.read_text()
    assert path.stat().st_mode & 0o077 == 0
    with pytest.raises(SinkError, match="time zone"):
        ring.add(Permission.READ, expires=datetime(2030, 1, 1))  # noqa: DTZ001 - what the test is about
    path.write_text('{"keys": [{}]}')
    with pytest.raises(SinkError, match="not a key file"):
        Keyring(path)


def test_server_with_certificate_accepts_tls_only(tmp_path: Path, rows: Rows) -> None:
    certificate, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    command = [
        "openssl",
        "req",
        "-x509",
        "-newkey",
        "rsa:2048",
        "-nodes",
        "-days",
        "2",
        "-subj",
        "/CN=localhost",
    ]
    command += ["-addext", "subjectAltName=DNS:localhost", "-keyout", str(key), "-out", str(certificate)]
    try:
        subprocess.run(command, check=True, capture_output=True)  # noqa: S603 - fixed arguments
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("openssl is not here")
    with serve(tmp_path / "served", "localhost", 0, tls=Tls(certificate, key)) as running:
        with Client(running, tls_root_certs=certificate.read_bytes()) as client:
            client.call("sequence_create", locator="drive", user_metadata={})
            client.upload("drive", "/imu", rows([1]))
        plain = fl.connect(f"grpc://localhost:{running.port}")
        with refused(Condition.UNAVAILABLE):
            list(plain.do_action(fl.Action("info", b"{}"), fl.FlightCallOptions(timeout=5)))
        plain.close()
