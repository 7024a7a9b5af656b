"""Recordings behind http:// and https://: ranges, retries, expiry, redaction and refusals."""

from __future__ import annotations

import json
import random
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from made_recordings import define, record
from web_server import WebServer, web_server

from mosaico_ingest import api
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import IngestError, ManifestError, NothingMatched, Unreachable
from mosaico_ingest.findings import mask_credentials
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.lint.engine import lint_paths
from mosaico_ingest.remote import Network, RemotePath, as_path, with_network
from mosaico_ingest.report.events import RunStatus
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.recording import open_recording
from mosaico_ingest.rosbag.source import _Prefetcher
from mosaico_ingest.web_files import WebFiles

BLOB = define("made/msg/Blob", "uint8[] data")
SECRET = "0badc0ffee"  # noqa: S105 - not a password
QUICK = Network(attempts=3, connect_s=1.0, request_s=0.5)


@pytest.fixture
def server() -> Iterator[WebServer]:
    with web_server() as running:
        yield running


@pytest.fixture(scope="module", params=[".mcap", ".db3"])
def recording(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    generator = random.Random(1)  # noqa: S311 - incompressible content
    path = tmp_path_factory.mktemp("web") / f"drive{request.param}"
    size = 500_000 if request.param == ".mcap" else 5_000
    messages = (
        ("/blob", BLOB, 10**9 * second, {"data": list(generator.randbytes(size))}) for second in range(8)
    )
    return record(path, messages)


def remote(server: WebServer, name: str, network: Network = QUICK) -> RemotePath:
    path = with_network(as_path(server.url(name)), network)
    assert isinstance(path, RemotePath)
    return path


def run(server: WebServer, folder: Path, name: str, **keys: object) -> tuple[RunStatus, str, Path]:
    """Ingest a file of the server, with its URL in a variable; return status, error and job."""
    job = folder / "job.yaml"
    network = {"attempts": 3, "connect_timeout": "1 s", "timeout": "500 ms"}
    manifest = {"bag": {"path": server.url(name)}, "target": {"store": "store"}, "network": network, **keys}
    job.write_text(json.dumps(manifest))
    (report,) = api.run(job).recordings
    return report.status, str(report.error), job


@pytest.mark.parametrize("ranges", [True, False])
def test_recording_of_web_server_equals_the_file(
    server: WebServer, recording: Path, tmp_path: Path, *, ranges: bool
) -> None:
    server.files[recording.name] = recording.read_bytes()
    server.ranges = ranges
    assert run(server, tmp_path, recording.name)[0] is RunStatus.COMPLETED
    api.run([ROSInjectionConfig(file_path=recording, sequence_name="local", store=tmp_path / "store")])
    store = Store.open(tmp_path / "store")
    assert store.topic("drive", "/blob").checksum == store.topic("local", "/blob").checksum
    assert {method for method, _ in server.requests} == {"GET"}


def test_inspecting_mcap_of_web_server_reads_a_small_part(server: WebServer, tmp_path: Path) -> None:
    blob = {"data": list(random.Random(1).randbytes(2_000_000))}  # noqa: S311 - incompressible content
    path = record(tmp_path / "large.mcap", [("/blob", BLOB, second, blob) for second in range(4)])
    server.files["large.mcap"] = path.read_bytes()
    with open_recording(remote(server, "large.mcap"), resolve=TypeResolver(None)) as opened:
        assert opened.message_count == 4
    assert server.sent_bytes < len(server.files["large.mcap"]) / 4


def test_reading_mcap_of_web_server_merges_chunks(server: WebServer, tmp_path: Path) -> None:
    generator = random.Random(1)  # noqa: S311 - incompressible content
    payloads = [list(generator.randbytes(1_200_000)) for _ in range(12)]
    messages = [("/blob", BLOB, second, {"data": payload}) for second, payload in enumerate(payloads)]
    path = record(tmp_path / "large.mcap", messages)
    server.files["large.mcap"] = path.read_bytes()
    with open_recording(remote(server, "large.mcap"), resolve=TypeResolver(None)) as opened:
        server.requests.clear()
        assert sum(map(len, opened.message_blocks())) == len(messages)
    assert len(server.requests) <= 8


def test_ranges_of_web_server_are_read_concurrently(
    server: WebServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = threading.Barrier(2, timeout=20)
    original = WebFiles.read_range

    def read_range(*arguments: Any) -> bytes:
        both.wait()
        return original(*arguments)

    monkeypatch.setattr(WebFiles, "read_range", read_range)
    server.files["a.mcap"] = b"content"
    path = remote(server, "a.mcap")
    with path.open_input() as file, ThreadPoolExecutor(2) as pool:
        assert list(pool.map(path.range_reader(file), (0, 4), (3, 7))) == [b"con", b"ent"]


def test_prefetcher_requests_the_following_range_while_one_is_read() -> None:
    both = threading.Barrier(2, timeout=20)

    def fetch(start: int, stop: int) -> bytes:
        if start:
            both.wait()
        return bytes(range(start, stop))

    prefetcher = _Prefetcher(fetch, iter([(0, 10), (10, 20), (20, 30)]))
    assert prefetcher.take(2, 10) == bytes(range(2, 10))
    assert prefetcher.take(40, 50) is None
    assert prefetcher.take(10, 20) == bytes(range(10, 20))
    assert prefetcher.take(20, 30) == bytes(range(20, 30))
    prefetcher.close()


def test_read_retries_server_errors(server: WebServer) -> None:
    server.files["a.mcap"] = b"content"
    server.failures = [503, 429]
    assert remote(server, "a.mcap").read_bytes() == b"content"


def test_read_at_behind_the_end_of_a_truncated_file_returns_nothing(server: WebServer) -> None:
    server.files["a.mcap"] = bytes(200)
    server.ranges = False
    path = remote(server, "a.mcap")
    with path.filesystem.open_input_file(path.filesystem_path) as file:
        server.files["a.mcap"] = bytes(50)
        assert path.range_reader(file)(100, 150) == b""


@pytest.mark.parametrize("ranges", [True, False])
def test_read_at_returns_the_range(server: WebServer, *, ranges: bool) -> None:
    server.files["a.mcap"] = bytes(range(200))
    server.ranges = ranges
    with remote(server, "a.mcap").open_input() as file:
        file.seek(50)
        assert file.read(3) == bytes([50, 51, 52])
        assert file.size() == 200
        file.seek(198)
        assert file.read(10) == bytes([198, 199])


def test_empty_file_has_size_zero(server: WebServer) -> None:
    server.files["a.mcap"] = b""
    assert remote(server, "a.mcap").stat().st_size == 0


def test_lasting_server_error_is_unreachable_after_attempts(server: WebServer) -> None:
    server.files["a.mcap"] = b"content"
    server.failures = [503] * 20
    with pytest.raises(Unreachable, match="503"):
        remote(server, "a.mcap").stat()
    assert len(server.requests) == QUICK.attempts


def test_server_that_does_not_respond_is_unreachable(server: WebServer) -> None:
    server.delay_s = 0.3
    network = Network(attempts=1, connect_s=1.0, request_s=0.05)
    with pytest.raises(Unreachable, match="ReadTimeoutError"):
        remote(server, "a.mcap", network).stat()


def test_missing_file_is_nothing_matched(server: WebServer, tmp_path: Path) -> None:
    with pytest.raises(NothingMatched):
        run(server, tmp_path, "missing.mcap")


def test_expired_url_fails_with_hint_and_without_query(
    server: WebServer, recording: Path, tmp_path: Path
) -> None:
    server.files[recording.name] = recording.read_bytes()
    server.query = f"X-Amz-Expires=60&X-Amz-Signature={SECRET}"
    server.expires_after = 5
    status, error, _ = run(server, tmp_path, recording.name)
    assert status is RunStatus.FAILED
    assert "HTTP status 403" in error
    assert SECRET not in error


def test_changed_file_is_not_read_further(server: WebServer) -> None:
    server.files["a.mcap"] = b"content"
    path = remote(server, "a.mcap")
    before = path.version()
    server.tag = "v2"
    assert path.version() != before


def test_presigned_url_is_in_no_report_plan_or_store(
    server: WebServer, recording: Path, tmp_path: Path
) -> None:
    server.files[recording.name] = recording.read_bytes()
    server.query = f"X-Amz-Credential={SECRET}&X-Amz-Signature={SECRET}"
    job = tmp_path / "job.yaml"
    job.write_text(json.dumps({"bag": {"path": server.url(recording.name)}, "target": {"store": "store"}}))
    report = api.run(job)
    assert report.exit_code == 0
    assert SECRET not in report.model_dump_json()
    assert SECRET not in api.plan_job(job).model_dump_json()
    assert SECRET not in str(Store.open(tmp_path / "store").sequence("drive").metadata)
    assert server.url(recording.name).partition("?")[0] in report.model_dump_json()
    assert SECRET not in str([finding.message for finding in lint_paths([job], env={}).findings])


@pytest.mark.parametrize(
    "option", ["X-Amz-Signature", "X-Amz-Credential", "sig", "GoogleAccessId", "Signature", "Policy", "token"]
)
def test_mask_credentials_masks_options_of_presigned_urls(option: str) -> None:
    assert SECRET not in mask_credentials(f"https://host/a.mcap?part=1&{option}={SECRET}&x=2")


def test_glob_of_web_server_is_refused(server: WebServer, tmp_path: Path) -> None:
    with pytest.raises(IngestError, match="list"):
        run(server, tmp_path, "*.mcap")


def test_store_behind_web_server_is_refused(server: WebServer, tmp_path: Path) -> None:
    path = record(tmp_path / "drive.mcap", [("/blob", BLOB, 1, {"data": [1]})])
    job = tmp_path / "job.yaml"
    job.write_text(json.dumps({"bag": {"path": path.name}, "target": {"store": server.url("store")}}))
    (report,) = api.run(job).recordings
    assert "cannot be written" in str(report.error)


@pytest.mark.parametrize("network", [{"attempts": 0}, {"timeout": "0"}, {"retries": 3}])
def test_wrong_network_settings_are_refused(tmp_path: Path, network: object) -> None:
    job = tmp_path / "job.yaml"
    job.write_text(json.dumps({"bag": {"path": "a.mcap"}, "network": network}))
    with pytest.raises(ManifestError):
        api.compile_job(job)
