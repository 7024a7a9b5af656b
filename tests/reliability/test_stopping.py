"""Stopping a run: a stored sequence stays until the new one is complete, and the same command completes the run."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from mosaico_ingest import api
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.report.events import CommitStarted, Event, RunStatus, TopicProgress
from mosaico_ingest.report.recording import Report

from .conftest import CUT, RunJob, WriteBag, number

WriteJob = Callable[..., Path]


def stop_after_rows(job: Path) -> Report:
    """Interrupt a job when the second batch of rows is counted."""
    batches = 0

    def stop(_position: int, event: Event) -> None:
        nonlocal batches
        if isinstance(event, TopicProgress) and event.written > 0:
            batches += 1
            if batches == 2:
                raise KeyboardInterrupt

    (report,) = api.run(api.compile_job(job), observe=stop).recordings
    assert batches >= 2
    return report


def rows(folder: Path) -> int:
    info = Store.open(folder / "store").find_sequence("drive")
    return info.rows if info else 0


@pytest.mark.parametrize("if_exists", ["replace", "append"])
def test_run_interrupted_with_stored_sequence_leaves_it_unchanged(
    if_exists: str, write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1)] * 70_000})
    assert run_job(write_job()).status is RunStatus.COMPLETED
    report = stop_after_rows(write_job(sequence={"name": "drive", "if_exists": if_exists}))
    assert report.status is RunStatus.INTERRUPTED
    assert report.totals.written == 0
    assert rows(tmp_path) == 70_000
    assert Store.open(tmp_path / "store").sequence("drive").notes == ()


def test_run_with_error_replacing_stored_sequence_leaves_it_unchanged(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1)]})
    assert run_job(write_job()).status is RunStatus.COMPLETED
    (tmp_path / "drive.db3").unlink()
    write_bag({"/speed": [number(1)] * 70_000 + [b"\x00\x01\x00\x00\x01"]})
    replace = write_job(sequence={"name": "drive", "if_exists": "replace"}, on_error={"message": "raise"})
    assert run_job(replace).status is RunStatus.FAILED
    assert rows(tmp_path) == 1


def test_run_repeated_after_interrupt_completes_sequence(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(value) for value in range(70_000)]})
    job = write_job()
    stopped = stop_after_rows(job)
    assert (stopped.status, stopped.totals.promised) == (RunStatus.INTERRUPTED, 70_000)
    assert 0 < rows(tmp_path) < 70_000
    assert api.plan_job(job).exit_code == 0
    assert run_job(job).status is RunStatus.COMPLETED
    assert api.plan_job(job).exit_code == 1
    assert rows(tmp_path) == 70_000
    assert run_job(job).exit_code == 1, "a complete sequence is not replaced"


def test_run_of_other_job_after_interrupt_fails(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(value) for value in range(70_000)]})
    stop_after_rows(write_job())
    before = rows(tmp_path)
    other = write_job(file="other.yaml", topic_settings={"/speed": {"every": 2}})
    assert run_job(other).exit_code == 1
    assert rows(tmp_path) == before


@pytest.mark.parametrize("if_exists", ["fail", "replace"])
def test_run_interrupted_before_first_row_is_written_publishes_nothing(
    if_exists: str, write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    def stop(_position: int, event: Event) -> None:
        if isinstance(event, TopicProgress) and event.written:
            raise KeyboardInterrupt

    write_bag({"/speed": [number(1)] * 10})
    if if_exists == "replace":
        assert run_job(write_job()).status is RunStatus.COMPLETED
    job = write_job(sequence={"name": "drive", "if_exists": if_exists})
    (report,) = api.run(api.compile_job(job), observe=stop).recordings
    assert (report.status, report.totals.written) == (RunStatus.INTERRUPTED, 0)
    info = Store.open(tmp_path / "store").find_sequence("drive")
    assert (info.rows if info else None, info.notes if info else ()) == (
        10 if if_exists == "replace" else None,
        (),
    )


@pytest.mark.parametrize("lost_at", [TopicProgress, CommitStarted])
@pytest.mark.parametrize(
    "payloads", [[number(1)] * 10, [number(1)] * 70_000 + [CUT]], ids=["complete", "failed"]
)
def test_run_that_loses_its_observer_publishes_nothing(
    payloads: list[bytes],
    lost_at: type[Event],
    write_bag: WriteBag,
    write_job: WriteJob,
    tmp_path: Path,
) -> None:
    def stop(_position: int, event: Event) -> None:
        nonlocal is_lost
        is_lost = is_lost or isinstance(event, lost_at)
        if is_lost:
            raise BrokenPipeError

    is_lost = False
    write_bag({"/speed": payloads})
    job = write_job(on_error={"session": "report", "message": "raise"})
    with pytest.raises(BrokenPipeError):
        api.run(api.compile_job(job), observe=stop)
    assert Store.open(tmp_path / "store").names() == ()


def test_error_of_commit_after_error_of_run_reports_first_error(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_file: object, _rows: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(tmp_path / "store"))

    write_bag({"/speed": [number(1)] * 70_000})
    monkeypatch.setattr("mosaico_ingest.destinations.store.session._FIRST_GROUP_BYTES", 1 << 10)
    monkeypatch.setattr("mosaico_ingest.destinations.store.segment.SegmentWriter.append", full)
    report = run_job(write_job())
    assert (report.status, report.exit_code) == (RunStatus.FAILED, 1)
    assert "No space left on device" in str(report.error)
    assert "an earlier write" not in str(report.error)
    assert rows(tmp_path) == 0
