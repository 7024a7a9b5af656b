"""Hostile recordings, manifests and names: one error line, and no file outside the store."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosaico_ingest import api
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import IngestError, ManifestError
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.report.run import RunReport

from .conftest import RunJob, WriteBag, number

WriteJob = Callable[..., Path]
DRIVE = (Path(__file__).parents[2] / "configs" / "quickstart" / "drive.mcap").read_bytes()
MAGIC = [b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n", b"SQLite format 3\x00", b"\x28\xb5\x2f\xfd", b""]
YAML_WORDS = st.sampled_from(
    ["bag", "path", ": ", "\n", "  ", "- ", "[", "]", "{", "}", "&a ", "*a", "!!python/object:os.system ", "<<: ",
     "${HOME}", "../", "x.mcap", "sequence", "name", "topics", "'", '"', "#", "|", "1e999", "\t", "\x00", "é", "extends"]
)  # fmt: skip


def ingest(data: bytes) -> RunReport:
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder, "any.bag")
        recording.write_bytes(data)
        config = ROSInjectionConfig(recording, "drive", store=Path(folder, "store"))
        report = api.run([config])
        assert {path.name for path in Path(folder).iterdir()} <= {"any.bag", "store"}
    return report


def told(report: RunReport) -> None:
    """Check that a run succeeded or failed with one error line that is not an internal error."""
    (recording,) = report.recordings
    error = recording.error or ""
    assert report.exit_code in {0, 1, 3, 4}, error
    assert "unexpected" not in error
    assert "\n" not in error


@given(st.sampled_from(MAGIC), st.binary(max_size=400))
def test_run_of_random_bytes_succeeds_or_fails_with_error(magic: bytes, rest: bytes) -> None:
    told(ingest(magic + rest))


@settings(max_examples=settings().max_examples // 10)
@given(st.integers(0, len(DRIVE) - 1), st.binary(min_size=1, max_size=40))
def test_run_of_mutated_recording_is_ingested_or_refused(at: int, change: bytes) -> None:
    told(ingest(DRIVE[:at] + change + DRIVE[at + len(change) :]))


@given(st.lists(YAML_WORDS | st.text(max_size=6), max_size=40).map("".join))
def test_manifest_of_random_text_is_loaded_or_has_findings(text: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        job = Path(folder, "job.yaml")
        job.write_text(text, encoding="utf-8", errors="replace")
        with suppress(IngestError):
            api.compile_job(job)
        assert [path.name for path in Path(folder).iterdir()] == ["job.yaml"]


def test_manifest_alias_bomb_is_refused_quickly(tmp_path: Path) -> None:
    lines = ["a0: &a0 [x]", *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 30))]
    job = tmp_path / "job.yaml"
    job.write_text("\n".join(lines))
    with pytest.raises(ManifestError):
        api.compile_job(job)


@pytest.mark.parametrize("name", ["..", ".", "../out", "a/../../out", "/out", "a\x00b", "a\\..\\b", ""])
def test_sequence_name_stays_inside_the_store(
    name: str, write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1)]})
    job = write_job(sequence={"name": name}, quarantine={})
    before = set(tmp_path.parent.iterdir())
    with suppress(IngestError):
        run_job(job)
    assert set(tmp_path.parent.iterdir()) == before
    assert {path.name for path in tmp_path.iterdir()} <= {"drive.db3", "job.yaml", "definitions", "store"}


@pytest.mark.parametrize(
    "topic", ["/std/../../../out", "/std/..", "/std//x", "/std/ü", "/std/a b", "/std/" + "x" * 300]
)
def test_topic_name_stays_inside_the_store(
    topic: str, write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({topic: [number(1)], "/speed": [number(2)]})
    report = run_job(write_job(on_error={"topic": "ignore"}))
    assert "unexpected" not in str(report.error)
    assert {path.name for path in tmp_path.iterdir()} == {"drive.db3", "job.yaml", "definitions", "store"}
    store = Store.open(tmp_path / "store")
    assert all(
        path.resolve().is_relative_to(store.layout.segments.resolve())
        for path in store.layout.segment_files()
    )


def test_run_executes_no_code_beside_the_manifest(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    (tmp_path / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    write_bag({"/speed": [number(1)]})
    run_job(write_job())
    assert not (tmp_path / "ran").exists()
