"""Recordings and stores behind az://: content, retries, timeouts and errors."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from blob_service import ACCOUNT, BlobService, blob_service
from made_recordings import define, record

from mosaico_ingest import api
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import IngestError, Unreachable
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.remote import Network, RemotePath, as_path, with_network

FLOAT = define("made/msg/Float", "float64 data")
KEY = "c2VjcmV0"
QUICK = Network(attempts=3, connect_s=1.0, request_s=0.3)


@pytest.fixture
def service(monkeypatch: pytest.MonkeyPatch) -> Iterator[BlobService]:
    monkeypatch.setenv("AZURE_STORAGE_KEY", KEY)
    with blob_service() as running:
        yield running


def remote(service: BlobService, name: str, network: Network = QUICK, **options: str) -> RemotePath:
    path = with_network(as_path(service.url(name, **options)), network)
    assert isinstance(path, RemotePath)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
def test_recordings_and_store_of_container_equal_the_files(
    service: BlobService, tmp_path: Path, suffix: str
) -> None:
    for name in ("a", "b"):
        messages = [("/a", FLOAT, 10**9 * second, {"data": float(second)}) for second in range(20)]
        path = record(tmp_path / f"{name}{suffix}", messages)
        service.blobs[f"in/{path.name}"] = path.read_bytes()
        config = ROSInjectionConfig(file_path=path, sequence_name=name, store=tmp_path / "local")
        assert api.run([config]).exit_code == 0
    job = tmp_path / "job.yaml"
    manifest = {"bag": {"path": service.url(f"in/*{suffix}")}, "target": {"store": service.url("store")}}
    job.write_text(json.dumps(manifest))
    report = api.run(job)
    assert report.exit_code == 0
    there, here = Store.open(as_path(service.url("store"))), Store.open(tmp_path / "local")
    for name in ("a", "b"):
        assert there.topic(name, "/a").checksum == here.topic(name, "/a").checksum
        assert there.scan(name, "/a").read_all().equals(here.scan(name, "/a").read_all())
    assert KEY not in report.model_dump_json()


def test_listing_has_folders_and_blobs(service: BlobService) -> None:
    service.blobs.update({"day/1/a.mcap": b"12", "day/2/b.mcap": b"3", "other": b""})
    day = remote(service, "day")
    assert [str(path).rpartition("/")[2] for path in day.iterdir()] == ["1", "2"]
    assert [path.name for path in day.glob("**/*.mcap")] == ["a.mcap", "b.mcap"]
    assert day.is_dir()
    assert not remote(service, "da").exists()
    assert remote(service, "other").is_file()


def test_write_of_many_blocks_is_read_back_and_removed(service: BlobService) -> None:
    content = bytes(range(256)) * 80_000
    path = remote(service, "large")
    path.write_bytes(content)
    assert service.blobs["large"] == content
    assert path.read_bytes() == content
    with path.open_input() as file:
        file.seek(300)
        assert file.read(2) == content[300:302]
    path.unlink()
    with pytest.raises(FileNotFoundError):
        path.stat()


def test_request_is_repeated_up_to_the_number_of_attempts(service: BlobService) -> None:
    service.blobs["a"] = b"content"
    service.failures = [503, 500]
    assert remote(service, "a").read_bytes() == b"content"
    service.requests.clear()
    service.failures = [503] * 10
    with pytest.raises(Unreachable, match="503"):
        remote(service, "a").stat()
    assert len(service.requests) == QUICK.attempts


def test_service_that_does_not_respond_is_unreachable_after_the_timeout(service: BlobService) -> None:
    service.delay_s = 2.0
    start_s = time.monotonic()
    with pytest.raises(Unreachable, match="does not respond"):
        remote(service, "a", Network(attempts=1, connect_s=1.0, request_s=0.1)).stat()
    assert time.monotonic() - start_s < 1.5


def test_version_changes_with_the_content(service: BlobService) -> None:
    service.blobs["a"] = b"one"
    before = remote(service, "a").version()
    service.blobs["a"] = b"two"
    assert remote(service, "a").version() != before


def test_missing_container_is_an_error_that_names_it(service: BlobService) -> None:
    path = remote(service, "a.mcap", container="missing")
    for request in (path.exists, lambda: list(path.parent.iterdir())):
        with pytest.raises(IngestError, match=r"az://missing\S*: the container does not exist"):
            request()


def test_refused_access_is_an_error_without_the_token(
    service: BlobService, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("AZURE_STORAGE_KEY")
    monkeypatch.setenv("AZURE_STORAGE_SAS_TOKEN", f"?sv=2021&sig={KEY}")
    with pytest.raises(IngestError, match="access is refused: HTTP status 403") as error:
        remote(service, "a").stat()
    assert KEY not in str(error.value)


def test_url_without_account_is_an_error(service: BlobService, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AZURE_STORAGE_ACCOUNT_NAME", raising=False)
    url = service.url("a").replace(f"account_name={ACCOUNT}&", "")
    with pytest.raises(IngestError, match="names no storage account"):
        as_path(url).exists()


@pytest.mark.parametrize(
    ("operation", "arguments"),
    [
        ("create_dir", ["container/a"]),
        ("delete_dir", ["container/a"]),
        ("move", ["container/a", "container/b"]),
        ("copy_file", ["container/a", "container/b"]),
        ("open_append_stream", ["container/a"]),
    ],
)
def test_unsupported_operation_is_named(service: BlobService, operation: str, arguments: list[str]) -> None:
    path = as_path(service.url("a"))
    assert isinstance(path, RemotePath)
    with pytest.raises(IngestError, match=f"^az://container/a: the operation {operation} is not supported: "):
        getattr(path.filesystem, operation)(*arguments)
