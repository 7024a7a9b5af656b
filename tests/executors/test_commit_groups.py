"""Recordings that are committed together: which they are, and an error of one of them."""

from __future__ import annotations

import errno
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from mosaico_ingest import executors as groups
from mosaico_ingest.destinations.store import Store, files, session
from mosaico_ingest.destinations.store.catalog import Catalog
from mosaico_ingest.errors import SinkError
from mosaico_ingest.executors import InProcess
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.report.events import CommitStarted, Event, RunFinished, RunStatus, ignore_batch
from mosaico_ingest.report.recording import Report

DRIVE = Path(__file__).resolve().parents[2] / "configs" / "quickstart" / "drive.mcap"


def task(folder: Path, name: str, recording: Path = DRIVE, **sections: Any) -> Task:
    config = ROSInjectionConfig(
        recording, name, topics=["/imu"], store=folder / "store", manifest=sections or None
    )
    return Task(config.job)


@pytest.fixture(autouse=True)
def unhurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep a busy machine from ending a group."""
    monkeypatch.setattr(groups, "_MAX_S", 60.0)


@pytest.fixture
def commits(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The sequences of each transaction that was tried."""
    names: list[list[str]] = []
    commit = Catalog.commit

    def recorded(catalog: Catalog, sessions: Sequence[Any]) -> list[str]:
        names.append([claim.sequence for claim, _ in sessions])
        return commit(catalog, sessions)

    monkeypatch.setattr(Catalog, "commit", recorded)
    return names


def run(tasks: list[Task]) -> list[Report]:
    return list(InProcess().map(tasks, ignore_batch))


def test_small_recordings_are_committed_in_one_transaction(tmp_path: Path, commits: list[list[str]]) -> None:
    reports = run([task(tmp_path, name) for name in "abc"])
    assert commits == [["a", "b", "c"]]
    assert [report.status for report in reports] == [RunStatus.COMPLETED] * 3
    assert Store.open(tmp_path / "store").names() == ("a", "b", "c")


@pytest.mark.parametrize(
    ("tasks", "expected"),
    [
        ([("a", {}), ("a", {"sequence": {"if_exists": "append"}})], [["a"], ["a"]]),
        ([("a", {}), ("b", {"on_schema_change": "evolve"})], [["a"], ["b"]]),
    ],
    ids=["same sequence", "compared definitions"],
)
def test_recording_that_depends_on_others_starts_a_group(
    tasks: list[tuple[str, dict[str, Any]]],
    expected: list[list[str]],
    tmp_path: Path,
    commits: list[list[str]],
) -> None:
    jobs = [task(tmp_path, name, **sections) for name, sections in tasks]
    assert {report.exit_code for report in run(jobs)} == {0}
    assert commits == expected


def test_recording_for_another_destination_starts_a_group(tmp_path: Path, commits: list[list[str]]) -> None:
    run([task(tmp_path / folder, name) for folder, name in (("1", "a"), ("2", "b"), ("2", "c"))])
    assert commits == [["a"], ["b", "c"]]


@pytest.mark.parametrize(("limit", "value"), [("SMALL_BYTES", 0), ("_MAX_S", -1.0)])
def test_large_or_late_recording_starts_a_group(
    limit: str, value: float, tmp_path: Path, commits: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(groups, limit, value)
    run([task(tmp_path, name) for name in "ab"])
    assert commits == [["a"], ["b"]]


def test_failed_recording_does_not_stop_the_others_of_its_group(
    tmp_path: Path, commits: list[list[str]]
) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"no recording")
    reports = run([task(tmp_path, "a"), task(tmp_path, "b", broken), task(tmp_path, "c")])
    assert [report.exit_code for report in reports] == [0, 1, 0]
    assert commits == [["a", "c"]]


def test_session_that_cannot_be_committed_fails_alone(tmp_path: Path, commits: list[list[str]]) -> None:
    def create_b(position: int, event: Event) -> None:
        if position == 2 and isinstance(event, CommitStarted):
            Store.open(tmp_path / "store").create_sequence("b", {})

    reports = list(InProcess().map([task(tmp_path, name) for name in "abc"], create_b))
    assert [report.exit_code for report in reports] == [0, 1, 0]
    assert reports[1].totals.written == 0
    assert commits == [["a", "b", "c"], ["a"], ["b"], ["c"]]
    store = Store.open(tmp_path / "store")
    assert [info.rows for info in store.sequences()] == [1000, 0, 1000]
    assert len(list(store.layout.segment_files())) == 2
    assert store.layout.open_sessions() == []


def test_group_whose_files_cannot_be_synced_fails(
    tmp_path: Path, commits: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    fsync = files.fsync
    failures: list[Path] = []

    def fail_once(path: Path) -> None:
        if path.suffix == ".parquet" and not failures:
            failures.append(path)
            raise OSError(errno.EIO, "Input/output error", str(path))
        fsync(path)

    monkeypatch.setattr(files, "fsync", fail_once)
    monkeypatch.setattr(
        session, "_WORTH_A_THREAD_BYTES", 1 << 30
    )  # a large topic is synced before the commit
    reports = run([task(tmp_path, name) for name in "ab"])
    assert [report.exit_code for report in reports] == [1, 1]
    assert commits == []
    assert Store.open(tmp_path / "store").names() == ()


def test_interrupt_during_a_commit_that_fails_starts_no_other_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def commit(_catalog: Catalog, _sessions: Sequence[Any]) -> list[str]:
        signal.raise_signal(signal.SIGINT)
        raise SinkError("the disk is full")

    monkeypatch.setattr(Catalog, "commit", commit)
    monkeypatch.setattr(groups, "SMALL_BYTES", 0)
    (report,) = run([task(tmp_path, name) for name in "ab"])
    assert (report.sequence, report.status, report.exit_code) == ("a", RunStatus.INTERRUPTED, 130)
    assert "the disk is full" in str(report.error)


def test_report_of_a_recording_follows_its_commit(tmp_path: Path, commits: list[list[str]]) -> None:
    transactions: list[int] = []

    def count(_position: int, event: Event) -> None:
        if isinstance(event, RunFinished):
            transactions.append(len(commits))

    list(InProcess().map([task(tmp_path, name) for name in "ab"], count))
    assert transactions == [1, 1]
