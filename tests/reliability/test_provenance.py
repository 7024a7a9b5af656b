"""Repeated jobs: same content is skipped, other content is refused, an incomplete sequence is completed."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from mosaico_ingest import api
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.job.values import PROVENANCE_KEY
from mosaico_ingest.pipeline.provenance import content_digest
from mosaico_ingest.report.events import Event, RunStatus, TopicProgress
from mosaico_ingest.services.status import Status

from .conftest import CUT, RunJob, WriteBag, number

WriteJob = Callable[..., Path]
SKIP = {"name": "drive", "if_exists": "skip"}


def test_server_skip_of_same_job_does_nothing(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1)]})
    job = write_job(sequence=SKIP)
    assert run_job(job).status is RunStatus.COMPLETED
    before = Store.open(tmp_path / "store").sequence("drive")
    again = run_job(job)
    assert (again.status, again.exit_code, again.error) == (RunStatus.SKIPPED, 0, None)
    assert again.totals.written == 0
    assert Store.open(tmp_path / "store").sequence("drive") == before


def test_skip_recognizes_sequence_of_job_without_skip(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    bag = write_bag({"/speed": [number(1)]})
    assert run_job(write_job()).status is RunStatus.COMPLETED
    bag.rename(tmp_path / "moved.db3")
    job = write_job(
        sequence=SKIP,
        bag={"path": "moved.db3", "custom_msgs": [{"package": "own_msgs", "path": "definitions"}]},
    )
    assert run_job(job).status is RunStatus.SKIPPED


def test_skip_refuses_other_content(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1)]})
    job = write_job(sequence=SKIP)
    run_job(job)
    (tmp_path / "drive.db3").unlink()
    write_bag({"/speed": [number(2)]})
    report = run_job(job)
    assert (report.status, report.exit_code) == (RunStatus.FAILED, 1)
    assert report.error is not None
    assert "made from other content (drive.db3)" in report.error
    assert "replace or append" in report.error
    assert Store.open(tmp_path / "store").scan("drive", "/speed").read_all()["data"].to_pylist() == [1]
    assert run_job(write_job(sequence={**SKIP, "if_exists": "replace"})).status is RunStatus.COMPLETED
    assert Store.open(tmp_path / "store").scan("drive", "/speed").read_all()["data"].to_pylist() == [2]


def test_skip_refuses_same_recording_of_other_job(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob
) -> None:
    write_bag({"/speed": [number(1), number(2)]})
    run_job(write_job(sequence=SKIP))
    report = run_job(write_job(sequence=SKIP, topic_settings={"/speed": {"every": 2}}))
    assert report.status is RunStatus.FAILED
    assert "by another job" in str(report.error)


def test_skip_refuses_sequence_without_provenance(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1)]})
    Store.open(tmp_path / "store").create_sequence("drive", {PROVENANCE_KEY: "no provenance"})
    assert "no provenance record" in str(run_job(write_job(sequence=SKIP)).error)


def test_skip_completes_interrupted_sequence(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(value) for value in range(70_000)]})
    job = write_job(sequence=SKIP)

    batches = 0

    def stop(_position: int, event: Event) -> None:
        nonlocal batches
        if isinstance(event, TopicProgress) and event.written > 0:
            batches += 1
            if batches == 2:  # counted, and not handed over
                raise KeyboardInterrupt

    (stopped,) = api.run(api.compile_job(job), observe=stop).recordings
    assert stopped.status is RunStatus.INTERRUPTED
    store = Store.open(tmp_path / "store")
    assert 0 < store.sequence("drive").rows < 70_000
    assert run_job(job).status is RunStatus.COMPLETED
    assert store.sequence("drive").rows == 70_000
    assert run_job(job).status is RunStatus.SKIPPED


def test_skip_treats_sequence_with_rejected_rows_as_complete(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob
) -> None:
    write_bag({"/speed": [number(1), CUT]})
    job = write_job(sequence=SKIP)
    assert run_job(job).status is RunStatus.WITH_ERRORS
    assert run_job(job).status is RunStatus.SKIPPED


def rewritten(bag: Path, value: float, other: float) -> None:
    """Replace one number of a recording by another, and keep the file's size and modification time."""
    was = bag.stat()
    data = bag.read_bytes()
    assert data.count(number(value)) == 1
    bag.write_bytes(data.replace(number(value), number(other)))
    os.utime(bag, ns=(was.st_atime_ns, was.st_mtime_ns))


def test_skip_detects_change_between_samples_of_long_file(
    write_bag: WriteBag,
    write_job: WriteJob,
    run_job: RunJob,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("mosaico_ingest.pipeline.provenance._SAMPLES", 2)
    monkeypatch.setattr("mosaico_ingest.pipeline.provenance._READ_BYTES", 1 << 10)
    bag = write_bag({"/speed": [number(value) for value in range(1000)]})
    assert bag.stat().st_size > 32 << 10
    job = write_job(sequence=SKIP)
    assert run_job(job).status is RunStatus.COMPLETED
    bag.touch()
    assert run_job(job).status is RunStatus.SKIPPED, "a copy is the same, whatever its time"
    rewritten(bag, 500, 5000)
    assert "other content" in str(run_job(job).error)
    (recording,) = api.job_status(job)
    assert recording.status is Status.CHANGED
    rewritten(bag, 5000, 500)
    assert run_job(job).status is RunStatus.SKIPPED


def test_skip_does_not_read_long_file_with_same_modification_time(
    write_bag: WriteBag,
    write_job: WriteJob,
    run_job: RunJob,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("mosaico_ingest.pipeline.provenance._SAMPLES", 2)
    monkeypatch.setattr("mosaico_ingest.pipeline.provenance._READ_BYTES", 1 << 10)
    write_bag({"/speed": [number(value) for value in range(1000)]})
    job = write_job(sequence=SKIP)
    assert run_job(job).status is RunStatus.COMPLETED
    monkeypatch.delattr("mosaico_ingest.pipeline.provenance.full_digest")
    assert run_job(job).status is RunStatus.SKIPPED


@pytest.mark.parametrize("at", [0, 1 << 20, (3 << 20) - 1])
def test_content_digest_depends_on_every_byte(at: int, tmp_path: Path) -> None:
    data = bytearray(3 << 20)
    path = tmp_path / "recording"
    path.write_bytes(data)
    before = content_digest(path)
    data[at] = 1
    path.write_bytes(data)
    assert content_digest(path) != before
    path.write_bytes(data + b"\0")
    assert content_digest(path) != before
