"""SIGKILL of a parent, of its workers, or of both: each sequence is the old or the new one, and the next run completes."""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import pytest

from mosaico_ingest.destinations.store import Store

from .conftest import WriteBag, number

WriteJob = Callable[..., Path]
NAMES = ("one", "two", "three", "four", "five", "six")
TOPICS = tuple(f"/speed_{number}" for number in range(40))
ROWS = 1500
"""Rows per topic; many topics make many events, each of which may meet a broken pipe. Small recordings are grouped."""
VICTIMS = ("parent", "worker", "parent", "both")


def start(job: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "mosaico_ingest", "run", "-q", "--jobs", "2", str(job)]
    return subprocess.Popen(command, stderr=subprocess.DEVNULL)  # noqa: S603 - our own command


def children(pid: int) -> list[int]:
    try:
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def kill(process: subprocess.Popen[bytes], victim: str) -> list[int]:
    """Kill the parent, its workers, or both; return the ids of the workers."""
    workers = children(process.pid)
    victims = {"parent": [process.pid], "worker": workers, "both": [process.pid, *workers]}
    for pid in victims[victim]:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return workers


def wait_for_end(workers: list[int]) -> None:
    """Wait for workers that lost their parent; a process without a waiting parent becomes a zombie or disappears."""
    end = time.monotonic() + 60
    for pid in workers:
        stat = Path(f"/proc/{pid}/stat")
        while time.monotonic() < end:
            try:
                state = stat.read_text().rpartition(")")[2].split()[0]
            except OSError:
                break
            if state == "Z":
                break
            time.sleep(0.02)
        else:
            pytest.fail("a worker without a parent does not end")


def wait_for_session(process: subprocess.Popen[bytes], store: Path) -> None:
    """Wait until a worker has opened a session, before which a kill is harmless."""
    staging = store / "staging"
    before = set(staging.glob("*"))
    while process.poll() is None and set(staging.glob("*")) <= before:
        time.sleep(0.005)


def content(store: Path) -> dict[str, float]:
    """Return the value that all rows of each sequence have."""
    if not (store / "catalog.sqlite").exists():
        return {}
    opened = Store.open(store)
    values: dict[str, float] = {}
    for info in opened.sequences():
        speeds = [opened.scan(info.name, topic).read_all()["data"].to_pylist() for topic in TOPICS]
        assert speeds == [[speeds[0][0]] * ROWS] * len(TOPICS), "a part of a sequence was published"
        assert info.notes == ()
        values[info.name] = speeds[0][0]
    return values


def kill_and_look(write_bag: WriteBag, job: Path, store: Path, rounds: int) -> dict[str, set[bool]]:
    """Write or replace sequences repeatedly and kill processes of each run.

    Return per victim whether sequences were written before the kill.
    """
    moments = random.Random()  # noqa: S311 - any moment will do

    bags = [write_bag({topic: [number(0)] * ROWS for topic in TOPICS}, name=name) for name in NAMES]

    def write(value: float) -> None:
        for bag in bags:
            with closing(sqlite3.connect(bag)) as database, database:
                database.execute("UPDATE messages SET data = ?", (number(value),))

    def finish(value: float) -> float:
        started = time.monotonic()
        assert start(job).wait(120) == 0
        assert content(store) == dict.fromkeys(NAMES, value)
        return time.monotonic() - started

    finish(0)
    duration = finish(0)
    outcomes: dict[str, set[bool]] = {victim: set() for victim in VICTIMS}
    before = content(store)
    for value in range(1, rounds + 1):
        victim = VICTIMS[value % len(VICTIMS)]
        if moments.random() < 0.7:  # nothing is replaced, so `on_error.session` could keep a part
            for name in before:
                Store.open(store).delete_sequence(name)
            before = {}
        write(value)
        process = start(job)
        workers: list[int] = []
        wait_for_session(process, store)
        try:
            process.wait(duration * moments.uniform(0, 0.5))
        except subprocess.TimeoutExpired:
            workers = kill(process, victim)
        process.wait(120)
        wait_for_end(workers)
        after = content(store)
        assert all(after.get(name) in {before.get(name), value} for name in NAMES)
        outcomes[victim] |= {after.get(name) == value for name in NAMES}
        before = after
    finish(rounds)
    return outcomes


@pytest.fixture
def job(write_job: WriteJob) -> Path:
    bag = {"path": "*.db3", "custom_msgs": [{"package": "own_msgs", "path": "definitions"}]}
    return write_job(bag=bag, sequence={"name": "{stem}", "if_exists": "replace"}, run={"memory": "1MiB"})


@pytest.mark.slow
def test_batch_with_killed_processes_leaves_old_or_new_sequences_and_next_run_completes(
    write_bag: WriteBag, job: Path, tmp_path: Path
) -> None:
    outcomes = kill_and_look(write_bag, job, tmp_path / "store", 21)
    assert outcomes["parent"] | outcomes["both"] == {False, True}, "the moments were not where they matter"
