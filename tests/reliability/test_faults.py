"""Jobs that are killed or stopped, or whose files are removed: the store keeps the old or the new sequence."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from mosaico_ingest import api
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.report.events import Event, RunStatus, TopicProgress

from .conftest import RunJob, WriteBag, number

WriteJob = Callable[..., Path]
REPLACE = {"name": "drive", "if_exists": "replace"}


def start(job: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "mosaico_ingest.cli.app", "run", "-q", str(job)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)  # noqa: S603 - this interpreter, our own command


def speeds(store: Store) -> list[float]:
    return store.scan("drive", "/speed").read_all()["data"].to_pylist()


def kill_and_look(write_bag: WriteBag, job: Path, store: Path, rounds: int) -> int:
    """Replace the sequence repeatedly and kill each run; return the number of runs that replaced it before.

    Runs are killed between a third of the duration of an undisturbed run and a little after it.
    """
    moments = random.Random()  # noqa: S311 - any moment will do
    write_bag({"/speed": [number(0)] * 3000})
    started = time.monotonic()
    undisturbed = start(job)
    undisturbed.communicate()
    assert undisturbed.returncode == 0
    duration = time.monotonic() - started
    survivor = 0.0
    through = 0
    for source in range(1, rounds + 1):
        (job.parent / "drive.db3").unlink(missing_ok=True)
        write_bag({"/speed": [number(source)] * 3000})
        process = start(job)
        try:
            process.wait(duration * moments.uniform(0.3, 1.3))
        except subprocess.TimeoutExpired:
            process.kill()
        process.communicate()
        if not (store / "catalog.sqlite").exists() or "drive" not in Store.open(store).names():
            assert not survivor, "the old state is gone"
            continue
        actual = speeds(Store.open(store))
        assert actual == [actual[0]] * 3000
        assert actual[0] in {survivor, source}
        through += actual[0] == source
        survivor = actual[0]
    return through


def test_replacing_run_killed_leaves_old_or_new_and_next_run_completes(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    job = write_job(sequence=REPLACE)
    kill_and_look(write_bag, job, tmp_path / "store", 2)
    assert run_job(job).status is RunStatus.COMPLETED
    store = Store.open(tmp_path / "store")
    store.collect_garbage(grace_s=0)
    assert set(store.layout.segment_files()) == set(store.paths("drive", "/speed"))


@pytest.mark.slow
def test_replacing_run_killed_200_times_leaves_old_or_new_sequence(
    write_bag: WriteBag, write_job: WriteJob, tmp_path: Path
) -> None:
    through = kill_and_look(write_bag, write_job(sequence=REPLACE), tmp_path / "store", 200)
    assert 0 < through < 200, "the moments were not where they matter"


@pytest.mark.slow
@pytest.mark.parametrize("number_of_signal", [signal.SIGTERM, signal.SIGINT])
def test_run_stops_within_seconds_of_a_signal(
    number_of_signal: signal.Signals, write_bag: WriteBag, write_job: WriteJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1)] * 200_000})
    process = start(write_job(on_error={"session": "delete"}, topic_settings={"/speed": {"every": 1}}))
    while process.poll() is None and not list((tmp_path / "store").glob("staging/*")):
        time.sleep(0.005)
    process.send_signal(number_of_signal)
    _, output = process.communicate(timeout=10)
    if process.returncode == 0:
        pytest.skip("the machine was faster than the signal")
    assert process.returncode == 130
    assert output.startswith("error: ")
    assert Store.open(tmp_path / "store").names() == ()


@pytest.mark.parametrize("in_the_way", ["store", "store/catalog.sqlite"])
def test_run_with_other_file_at_store_path_fails(
    in_the_way: str, write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1)]})
    (tmp_path / in_the_way).parent.mkdir(exist_ok=True)
    (tmp_path / in_the_way).write_text("something else")
    report = run_job(write_job())
    assert report.exit_code == 1
    assert str(tmp_path / "store") in str(report.error)
    assert (tmp_path / in_the_way).read_text() == "something else"


def interrupted_by(job: Path, act: Callable[[], object]) -> tuple[RunStatus, int, str]:
    """Run a job and change its files after the first rows are written."""
    result: list[bool] = []

    def tell(_position: int, event: Event) -> None:
        if isinstance(event, TopicProgress) and event.written and not result:
            result.append(True)
            act()

    (report,) = api.run(api.compile_job(job), observe=tell).recordings
    assert result
    return report.status, report.exit_code, str(report.error)


def test_run_with_store_deleted_during_run_fails(
    write_bag: WriteBag, write_job: WriteJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1)] * 70_000})
    status, code, output = interrupted_by(write_job(), lambda: shutil.rmtree(tmp_path / "store"))
    assert (status, code) == (RunStatus.FAILED, 1)
    assert "store" in output


def test_run_of_recording_truncated_during_reading_reports_it(
    write_bag: WriteBag, write_job: WriteJob, tmp_path: Path
) -> None:
    bag = write_bag({"/speed": [number(1)] * 500_000})
    status, code, output = interrupted_by(write_job(), lambda: os.truncate(bag, bag.stat().st_size // 2))
    if status is RunStatus.COMPLETED:  # all of it had been read before
        assert Store.open(tmp_path / "store").sequence("drive").rows == 500_000
    else:
        assert code in {1, 4, 5}, output


def test_two_runs_write_two_sequences_of_one_store(
    write_bag: WriteBag, write_job: WriteJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1)] * 20_000})
    jobs = [write_job(file=f"{name}.yaml", sequence={"name": name}) for name in ("one", "two")]
    running = [start(job) for job in jobs]
    assert [(process.communicate()[1], process.returncode) for process in running] == [("", 0)] * 2
    store = Store.open(tmp_path / "store")
    assert [info.rows for info in store.sequences()] == [20_000] * 2


def test_two_runs_of_one_sequence_let_one_win(
    write_bag: WriteBag, write_job: WriteJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1)] * 20_000})
    job = write_job()
    running = [start(job), start(job)]
    ended = sorted((process.communicate()[1], process.returncode) for process in running)
    assert [code for _, code in ended] == [0, 1]
    assert "exists" in ended[1][0] or "another run is writing" in ended[1][0]
    assert len(speeds(Store.open(tmp_path / "store"))) == 20_000


def test_run_with_repeated_or_decreasing_log_times_keeps_every_message(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    import sqlite3  # noqa: PLC0415 - for this one

    bag = write_bag({"/speed": [number(value) for value in range(100)]})
    db = sqlite3.connect(bag)
    db.execute("UPDATE messages SET timestamp = timestamp - 500000000 WHERE rowid % 3 = 0")
    db.execute("UPDATE messages SET timestamp = 1700000000000000000 WHERE rowid % 7 = 0")
    db.commit()
    db.close()
    report = run_job(write_job())
    assert (report.status, report.totals.written) == (RunStatus.COMPLETED, 100)
    table = Store.open(tmp_path / "store").scan("drive", "/speed").read_all()
    times = table["timestamp_ns"].to_pylist()
    assert times == sorted(times)
    assert sorted(table["data"].to_pylist()) == list(range(100))
