"""`ingest serve` with keys, as the destination of `ingest bag`."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Generator
from datetime import datetime, timezone
from pathlib import Path

import pyarrow as pa
import pytest
from pyarrow import flight

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.protocol.messages import Permission
from mosaico_ingest.serve import Keyring, Tls, serve

ROOT = Path(__file__).resolve().parents[2]
RECORDING = ROOT / "configs" / "quickstart" / "drive.mcap"


def ingest(*arguments: str, cwd: Path, key: str | None = None) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, **({"MOSAICO_API_KEY": key} if key else {})}
    return subprocess.run(  # noqa: S603 - our own command
        [sys.executable, "-m", "mosaico_ingest", *arguments],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture
def served(tmp_path: Path) -> Generator[tuple[Path, str, str]]:
    """A folder, the port of a server over its store, and a key that may write."""
    key = ingest("keys", "new", "--permission", "write", cwd=tmp_path).stdout.strip()
    command = [sys.executable, "-m", "mosaico_ingest", "serve", "--port", "0", "--api-keys", "api_keys.json"]
    server = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True)  # noqa: S603 - our own command
    assert server.stdout is not None
    port = re.search(r":(\d+)$", server.stdout.readline())
    assert port is not None
    yield tmp_path, port[1], key
    server.send_signal(signal.SIGTERM)
    assert server.wait(timeout=20) == 0
    server.stdout.close()


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Generator[dict[str, str]]:
    """The ports of a server without TLS and of one with it, its certificate, and a key that has expired."""
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("openssl makes the certificate, and is not here")
    folder = tmp_path_factory.mktemp("places")
    cert, key = folder / "cert.pem", folder / "key.pem"
    words = f"req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 -subj /CN=localhost -addext subjectAltName=DNS:localhost -keyout {key} -out {cert}"
    subprocess.run([openssl, *words.split()], check=True, capture_output=True)  # noqa: S603 - our own words
    ring = Keyring(folder / "keys.json")
    expired = ring.add(Permission.WRITE, expires=datetime(2020, 1, 1, tzinfo=timezone.utc))
    with (
        serve(folder / "plain", port=0, keys=ring) as plain,
        serve(folder / "tls", port=0, keys=ring, tls=Tls(cert, key)) as secure,
    ):
        yield {"port": str(plain.port), "tls": str(secure.port), "cert": str(cert), "expired": expired}


def test_bag_to_server_is_in_its_store(served: tuple[Path, str, str]) -> None:
    folder, port, key = served
    arguments = ("bag", str(RECORDING), "--name", "drive", "--host", "127.0.0.1", "--port", port)
    result = ingest(*arguments, cwd=folder, key=key)
    assert result.returncode == 0, result.stderr
    assert key not in result.stdout + result.stderr
    topics = Store.open(folder / "mosaico", create=False).sequence("drive").topics
    assert sum(topic.rows for topic in topics) == 2130


@pytest.mark.promise("write-permission")
def test_bag_with_read_key_is_refused(served: tuple[Path, str, str]) -> None:
    folder, port, _ = served
    key = ingest("keys", "new", "--permission", "read", "--api-keys", "other.json", cwd=folder).stdout.strip()
    arguments = ("bag", str(RECORDING), "--name", "drive", "--host", "127.0.0.1", "--port", port)
    result = ingest(*arguments, cwd=folder, key=key)
    assert result.returncode == 1
    assert "Traceback" not in result.stderr
    assert key not in result.stdout + result.stderr


def test_keys_ls_does_not_print_keys(served: tuple[Path, str, str]) -> None:
    folder, _, key = served
    listed = ingest("keys", "ls", cwd=folder).stdout
    assert "write" in listed
    assert key not in listed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--host", "no-such-host.invalid"), "'no-such-host.invalid' cannot be resolved"),
        (("--host", "grpc://127.0.0.1:{port}"), "is neither a host name nor an IP address"),
        (
            ("--host", "127.0.0.1", "--port", "{port}", "--tls-cert", "{cert}"),
            "the server does not use TLS",
        ),
        (("--host", "127.0.0.1", "--port", "{tls}"), "accepts only TLS connections"),
        (("--host", "127.0.0.1", "--port", "{tls}", "--tls-cert", "{cert}"), "the certificate is not for"),
        (
            ("--host", "127.0.0.1", "--port", "{port}", "--api-key", "{expired}"),
            "the API key expired on 2020",
        ),
        (
            ("--host", "127.0.0.1", "--port", "{port}", "--api-key", "msco_x"),
            "the API key is refused: it is not",
        ),
        (("--host", "127.0.0.1", "--port", "{port}"), "the server requires an API key"),
    ],
)
def test_bag_server_error_is_one_line(
    places: dict[str, str], tmp_path: Path, options: tuple[str, ...], said: str
) -> None:
    arguments = [option.format(**places) for option in options]
    result = ingest("bag", str(RECORDING), "--name", "refused", "--quiet", *arguments, cwd=tmp_path)
    assert result.returncode == 1
    (line,) = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert said in line
    assert "Traceback" not in result.stderr
    assert places["expired"] not in result.stderr


def test_serve_interrupt_with_open_upload_stops_immediately(served: tuple[Path, str, str]) -> None:
    """The fixture's end expects the server to leave; this client never ends its call."""
    _, port, key = served
    headers = [(b"mosaico-api-key-token", key.encode())]
    options = flight.FlightCallOptions(headers=headers)
    client = flight.connect(f"grpc://127.0.0.1:{port}")

    def act(name: str, **body: object) -> dict[str, str]:
        action = flight.Action(name, json.dumps(body).encode())
        (answer,) = client.do_action(action, options)
        return json.loads(answer.body.to_pybytes())["response"]

    act("sequence_create", locator="open", user_metadata={})
    session = act("session_create", locator="open")["uuid"]
    kind = {"serialization_format": "default", "ontology_tag": "Sample", "user_metadata": {}}
    topic = act("topic_create", session_uuid=session, locator="open/t", **kind)["uuid"]
    command = json.dumps({"resource_locator": "open/t", "topic_uuid": topic}).encode()
    schema = pa.schema([pa.field("timestamp_ns", pa.int64(), nullable=False)])
    client.do_put(flight.FlightDescriptor.for_command(command), schema, options)


def test_serve_certificate_without_key_exits_2(tmp_path: Path) -> None:
    result = ingest("serve", "--tls-cert", "cert.pem", cwd=tmp_path)
    assert result.returncode == 2
    assert "--tls-key" in result.stderr


def test_serve_help_lists_options(tmp_path: Path) -> None:
    result = ingest("serve", "--help", cwd=tmp_path)
    assert result.returncode == 0
    assert "--api-keys" in result.stdout
