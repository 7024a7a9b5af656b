"""`RemotePath`: it behaves like a pathlib path, and invalid URLs are refused without a request."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from mosaico_ingest.errors import IngestError, ManifestError, Unreachable
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.manifest import load_manifest
from mosaico_ingest.job.values import StoreTarget
from mosaico_ingest.pipeline.compile import compile_manifest
from mosaico_ingest.remote import RemotePath, as_path, filesystem, is_url, translate_errors


def test_remote_path_has_the_parts_of_a_path() -> None:
    path = as_path("s3://bucket/drives/a.mcap?region=eu-west-1")
    assert isinstance(path, RemotePath)
    assert (path.name, path.suffix, path.filesystem_path) == ("a.mcap", ".mcap", "bucket/drives/a.mcap")
    assert str(path) == "s3://bucket/drives/a.mcap"
    assert str(path.parent / "b" / "c.bag") == "s3://bucket/drives/b/c.bag"
    assert [str(one) for one in path.above] == ["s3://bucket/drives", "s3://bucket"]
    assert as_path(path.url) == path
    assert pickle.loads(pickle.dumps(path)) == path  # noqa: S301 - pickled in this line


@pytest.mark.parametrize("given", ["s3://bucket", "s3://bucket/"])
def test_remote_path_of_bucket_is_a_folder(given: str) -> None:
    path = as_path(given)
    assert isinstance(path, RemotePath)
    assert (path.name, str(path), str(path / "a")) == ("bucket", "s3://bucket", "s3://bucket/a")


@pytest.mark.parametrize("scheme", ["s3", "gs"])
def test_as_path_restores_a_url_that_pathlib_normalized(scheme: str) -> None:
    url = f"{scheme}://bucket/drives/a.mcap?anonymous=true"
    assert as_path(Path(url)) == as_path(url)


def test_remote_path_hash_is_part_of_the_name() -> None:
    assert as_path("s3://bucket/run#1.mcap?region=eu") == RemotePath("s3://bucket", "run#1.mcap", "region=eu")


def test_as_path_file_url_is_a_local_path() -> None:
    assert as_path("file:///data/with%20blank.mcap") == Path("/data/with blank.mcap")


@pytest.mark.parametrize("given", ["a.mcap", "./a/b", "/a//b", "C:a", "module.name:Class", "a b:/x"])
def test_as_path_other_text_is_a_local_path(given: str) -> None:
    assert not is_url(given)
    assert as_path(given) == Path(given)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("ftp://host/a.mcap", "unknown URL scheme ftp:// — use one of s3://, gs://, az://, https://, "),
        ("s3:///a.mcap", "no bucket"),
        ("s3://[bucket/a.mcap", "the URL is invalid: Invalid IPv6 URL"),
        ("s3://key:secret@bucket/a.mcap", "the URL contains credentials"),
    ],
)
def test_as_path_invalid_url_is_refused(given: str, said: str) -> None:
    with pytest.raises(IngestError, match=said) as raised:
        as_path(given)
    assert "secret" not in str(raised.value)


def test_filesystem_with_unknown_option_names_it_without_its_value() -> None:
    with pytest.raises(IngestError, match="'regoin' — the options are endpoint_override") as raised:
        filesystem("s3://bucket", "regoin=eu-west-1")
    assert "eu-west-1" not in str(raised.value)


def test_filesystem_of_gs_url_is_the_google_client() -> None:
    path = as_path("gs://bucket/a.mcap?anonymous=true&endpoint_override=127.0.0.1:1&scheme=http")
    assert isinstance(path, RemotePath)
    assert path.filesystem.type_name == "gcs"


@pytest.mark.parametrize(
    ("error", "kind", "said"),
    [
        (OSError("When reading: AWS Error NETWORK_CONNECTION during HeadObject operation: curlCode: 7"), Unreachable, "does not respond: NETWORK_CONNECTION"),
        (OSError("AWS Error SLOW_DOWN during GetObject operation"), Unreachable, "SLOW_DOWN"),
        (OSError("AWS Error ACCESS_DENIED during HeadObject operation"), IngestError, "access is refused"),
        (OSError("AWS Error NO_SUCH_BUCKET during CreateMultipartUpload (Request ID: x)"), IngestError, "bucket does not exist"),
        (FileNotFoundError(2, "gone"), FileNotFoundError, "gone"),
    ],
)  # fmt: skip
def test_client_error_becomes_a_typed_error(error: OSError, kind: type[Exception], said: str) -> None:
    with pytest.raises(kind, match=said) as raised, translate_errors("s3://bucket/a"):
        raise error
    assert type(raised.value) is kind


def test_config_accepts_urls() -> None:
    config = ROSInjectionConfig("s3://bucket/a.mcap", sequence_name="a", store="s3://bucket/store")
    assert config.job.paths == (as_path("s3://bucket/a.mcap"),)
    assert config.job.destination == StoreTarget(as_path("s3://bucket/store"))


def test_manifest_with_invalid_url_reports_its_location(tmp_path: Path) -> None:
    job = tmp_path / "job.yaml"
    job.write_text('version: 1\nbag: {path: "ftp://host/a.mcap"}\n')
    with pytest.raises(ManifestError, match=r"job.yaml:2:13: ftp://host/a.mcap: unknown URL scheme"):
        compile_manifest(load_manifest(job))


def test_manifest_accepts_urls_only_for_recordings_and_stores(tmp_path: Path) -> None:
    job = tmp_path / "job.yaml"
    (tmp_path / "a.mcap").write_bytes(b"")
    job.write_text(
        "version: 1\nbag: {path: a.mcap}\nsequence: {name: a}\nquarantine: {path: 's3://bucket/rejected'}\n"
    )
    with pytest.raises(ManifestError, match=r"job.yaml:4:20: .*is a URL"):
        compile_manifest(load_manifest(job))
