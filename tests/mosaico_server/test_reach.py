"""Failures to connect to a server: each raises one error line with its cause."""

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
    """A certificate for `localhost` and its private key."""
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("openssl is required to create the certificate")
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
    """Connect to a server that refuses; return the error, which is raised within 8 s."""
    begin = time.monotonic()
    target = ServerTarget(host, port, tls=tls, tls_cert=tls_cert)
    with pytest.raises(SinkError) as caught, connect(target):
        pytest.fail("connected")
    assert time.monotonic() - begin < 8
    assert "\n" not in str(caught.value)
    return caught.value


def test_connect_with_trusted_certificate_returns_client(
    secure: Mosaicod, certificate: tuple[Path, Path]
) -> None:
    with connect(ServerTarget("localhost", secure.port, tls_cert=certificate[0])) as client:
        assert client.version == "0.7.0"


def test_connect_unresolvable_host_raises() -> None:
    error = refusal("no-such-host.invalid", 6726)
    assert str(error) == (
        "grpc://no-such-host.invalid:6726: the host 'no-such-host.invalid' cannot be resolved — check target.host"
    )
    assert not error.retryable


@pytest.mark.parametrize("host", ["", "grpc://127.0.0.1:6726", "127.0.0.1:6726", "a b", "[::1]"])
def test_connect_invalid_host_raises(host: str) -> None:
    assert "is neither a host name nor an IP address — set target.host without scheme and port" in str(
        refusal(host, 6726)
    )


@pytest.mark.parametrize("host", ["::1", "fe80::1%lo", "127.0.0.1", "robot_7.local"])
def test_check_host_valid_host_is_accepted(host: str) -> None:
    _check_host(host)


def test_connect_to_web_server_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mosaico_ingest.destinations.server.client._DELAYS_S", (0.01,))
    with HTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler) as web:
        thread = threading.Thread(target=web.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        error = refusal("127.0.0.1", web.server_port)
        web.shutdown()
        thread.join()
    assert "the program at this address is not a Mosaico server — check target.host and target.port" in str(
        error
    )


def test_connect_to_closed_port_raises_sink_unavailable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mosaico_ingest.destinations.server.client._DELAYS_S", (0.01,))
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    error = refusal("127.0.0.1", port)
    assert isinstance(error, SinkUnavailable)
    assert "the connection is refused — check target.host and target.port" in str(error)


def test_connect_to_silent_port_raises_sink_unavailable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mosaico_ingest.destinations.server.client._PATIENCE_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        target = ServerTarget("127.0.0.1", silent.getsockname()[1])
        with pytest.raises(SinkUnavailable), connect(target, response_s=0.3):
            pytest.fail("connected")


def test_connect_with_tls_to_server_without_tls_raises() -> None:
    with running(Mosaicod()) as server:
        error = refusal("127.0.0.1", server.port, tls=True)
    assert str(error).endswith("the server does not use TLS — set target.tls: false")
    assert not error.retryable


def test_connect_without_tls_to_tls_server_raises(secure: Mosaicod) -> None:
    error = refusal("127.0.0.1", secure.port)
    assert str(error).endswith(
        "the server accepts only TLS connections — set target.tls: true, or target.tls_cert"
    )
    assert not error.retryable


def test_connect_untrusted_certificate_raises(secure: Mosaicod) -> None:
    error = refusal("localhost", secure.port, tls=True)
    assert "the certificate is not trusted: self" in str(error)
    assert "set target.tls_cert" in str(error)


def test_connect_certificate_for_other_name_raises(secure: Mosaicod, certificate: tuple[Path, Path]) -> None:
    error = refusal("127.0.0.1", secure.port, tls_cert=certificate[0])
    assert "the certificate is not for '127.0.0.1' — use the name the certificate is for" in str(error)


def test_connect_invalid_or_missing_certificate_file_raises(
    tmp_path: Path, certificate: tuple[Path, Path]
) -> None:
    (tmp_path / "text").write_text("hello")
    (tmp_path / "binary").write_bytes(b"\xff\xfe")
    for path in (tmp_path / "text", tmp_path / "binary", certificate[1]):
        assert "it contains no certificate" in str(refusal("localhost", 1, tls_cert=path))
    assert "No such file" in str(refusal("localhost", 1, tls_cert=tmp_path / "missing"))
