"""Every way a server cannot be reached is one line that says which."""

from __future__ import annotations

import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest
from mosaicod import Mosaicod, running

from mosaico_ingest.destinations.server.client import _check_host, connect
from mosaico_ingest.errors import SinkError, SinkUnavailable
from mosaico_ingest.job.values import ServerTarget


@pytest.fixture(scope="session")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A certificate for `localhost`, and its key."""
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("openssl makes the certificate, and is not here")
    folder = tmp_path_factory.mktemp("certificate")
    cert, key = folder / "cert.pem", folder / "key.pem"
    words = f"req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 -subj /CN=localhost -addext subjectAltName=DNS:localhost -keyout {key} -out {cert}"
    subprocess.run([openssl, *words.split()], check=True, capture_output=True)  # noqa: S603 - our own words
    return cert, key


@pytest.fixture
def secure(certificate: tuple[Path, Path]) -> Iterator[Mosaicod]:
    pair = tuple(path.read_bytes() for path in certificate)
    with running(Mosaicod("grpc+tls://127.0.0.1:0", tls_certificates=[pair])) as server:
        yield server


def refusal(host: str, port: int, *, tls: bool = False, tls_cert: Path | None = None) -> SinkError:
    """Return why there is no connection."""
    begin = time.monotonic()
    target = ServerTarget(host, port, tls=tls, tls_cert=tls_cert)
    with pytest.raises(SinkError) as caught, connect(target):
        pytest.fail("connected")
    assert time.monotonic() - begin < 8
    assert "\n" not in str(caught.value)
    return caught.value


def test_a_trusted_server_is_let_talk(secure: Mosaicod, certificate: tuple[Path, Path]) -> None:
    with connect(ServerTarget("localhost", secure.port, tls_cert=certificate[0])) as client:
        assert client.version == "0.7.0"


def test_a_host_nobody_knows() -> None:
    found = refusal("no-such-host.invalid", 6726)
    assert str(found) == (
        "grpc://no-such-host.invalid:6726: the host 'no-such-host.invalid' cannot be resolved — check target.host"
    )
    assert not found.retryable


@pytest.mark.parametrize("host", ["", "grpc://127.0.0.1:6726", "127.0.0.1:6726", "a b", "[::1]"])
def test_a_host_that_cannot_be_one(host: str) -> None:
    assert "is neither a host name nor an IP address — set target.host without scheme and port" in str(
        refusal(host, 6726)
    )


@pytest.mark.parametrize("host", ["::1", "fe80::1%lo", "127.0.0.1", "robot_7.local"])
def test_a_host_that_can_be_one(host: str) -> None:
    _check_host(host)


def test_a_web_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mosaico_ingest.destinations.server.client._DELAYS_S", (0.01,))
    with HTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler) as web:
        thread = threading.Thread(target=web.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        found = refusal("127.0.0.1", web.server_port)
        web.shutdown()
        thread.join()
    assert "the program at this address is not a Mosaico server — check target.host and target.port" in str(
        found
    )


def test_a_port_nobody_listens_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mosaico_ingest.destinations.server.client._DELAYS_S", (0.01,))
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    found = refusal("127.0.0.1", port)
    assert isinstance(found, SinkUnavailable)
    assert "the connection is refused — check target.host and target.port" in str(found)


def test_a_port_that_says_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mosaico_ingest.destinations.server.errors._PATIENCE_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        target = ServerTarget("127.0.0.1", silent.getsockname()[1])
        with pytest.raises(SinkUnavailable), connect(target, response_s=0.3):
            pytest.fail("connected")


def test_tls_where_the_server_has_none() -> None:
    with running(Mosaicod()) as server:
        found = refusal("127.0.0.1", server.port, tls=True)
    assert str(found).endswith("the server does not use TLS — set target.tls: false")
    assert not found.retryable


def test_no_tls_where_the_server_wants_it(secure: Mosaicod) -> None:
    found = refusal("127.0.0.1", secure.port)
    assert str(found).endswith(
        "the server accepts only TLS connections — set target.tls: true, or target.tls_cert"
    )
    assert not found.retryable


def test_a_certificate_nobody_vouches_for(secure: Mosaicod) -> None:
    found = refusal("localhost", secure.port, tls=True)
    assert "the certificate is not trusted: self" in str(found)
    assert "set target.tls_cert" in str(found)


def test_a_certificate_for_another_name(secure: Mosaicod, certificate: tuple[Path, Path]) -> None:
    found = refusal("127.0.0.1", secure.port, tls_cert=certificate[0])
    assert "the certificate is not for '127.0.0.1' — use the name the certificate is for" in str(found)


def test_a_certificate_file_that_is_none(tmp_path: Path, certificate: tuple[Path, Path]) -> None:
    (tmp_path / "text").write_text("hello")
    (tmp_path / "binary").write_bytes(b"\xff\xfe")
    for path in (tmp_path / "text", tmp_path / "binary", certificate[1]):
        assert "it contains no certificate" in str(refusal("localhost", 1, tls_cert=path))
    assert "No such file" in str(refusal("localhost", 1, tls_cert=tmp_path / "missing"))
