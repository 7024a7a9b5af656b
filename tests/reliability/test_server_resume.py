"""Repeated jobs with a server as destination: rows are stored exactly once, also after interruptions."""

from __future__ import annotations

import os
import random
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from mosaicod import Proxy

from mosaico_ingest import api
from mosaico_ingest.destinations.store import Store

from .conftest import WriteBag, number

WriteJob = Callable[..., Path]
pytestmark = pytest.mark.slow  # a server and several clients for each test
SKIP = {"name": "drive", "if_exists": "skip"}
ROWS = 20_000


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "mosaico_ingest", *map(str, arguments)]


def ran(*arguments: object) -> tuple[int, str]:
    """Run the command; return its exit code and output."""
    result = subprocess.run(  # noqa: S603 - our own command
        command(*arguments), capture_output=True, text=True, check=False, timeout=120
    )
    assert "Traceback" not in result.stderr, result.stderr
    return result.returncode, result.stdout + result.stderr


@contextmanager
def serving(folder: Path, port: int = 0) -> Generator[tuple[int, subprocess.Popen[str]], None, None]:
    """Serve `served` in a separate process; yield its port and the process."""
    arguments = command("serve", "--port", port, "--store", folder / "served")
    server = subprocess.Popen(  # noqa: S603 - our own command
        arguments, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=folder
    )
    assert server.stdout is not None
    match = re.search(r":(\d+)$", server.stdout.readline())
    try:
        assert match is not None
        yield int(match[1]), server
    finally:
        server.send_signal(signal.SIGTERM)
        try:
            server.wait(timeout=20)
        finally:
            server.kill()
            server.stdout.close()


@pytest.fixture
def port(tmp_path: Path) -> Generator[int, None, None]:
    """The port of a server of the store `served`."""
    with serving(tmp_path) as (actual, _):
        yield actual


def to(port: int) -> dict[str, Any]:
    return {"target": {"host": "127.0.0.1", "port": port}}


def speeds(folder: Path, topic: str = "/speed") -> list[float]:
    return Store.open(folder / "served").scan("drive", topic).read_all()["data"].to_pylist()


def test_skip_of_same_job_reports_skipped(
    write_bag: WriteBag, write_job: WriteJob, tmp_path: Path, port: int
) -> None:
    write_bag({"/speed": [number(1), number(2)]})
    job = write_job(sequence=SKIP, **to(port))
    assert ran("run", job)[0] == 0
    before = Store.open(tmp_path / "served").sequence("drive")
    code, output = ran("run", job)
    assert code == 0
    assert "it already has the same content" in output
    assert Store.open(tmp_path / "served").sequence("drive") == before


def test_changed_content_is_refused_by_skip_and_replaced_by_replace(
    write_bag: WriteBag, write_job: WriteJob, tmp_path: Path, port: int
) -> None:
    write_bag({"/speed": [number(1)]})
    job = write_job(sequence=SKIP, **to(port))
    assert ran("run", job)[0] == 0
    (tmp_path / "drive.db3").unlink()
    write_bag({"/speed": [number(2)]})
    code, output = ran("run", job)
    assert code == 1
    assert "made from other content (drive.db3)" in " ".join(output.split())
    assert speeds(tmp_path) == [1]
    write_job(sequence={**SKIP, "if_exists": "replace"}, **to(port))
    (plan,) = api.plan_job(job).recordings
    rule = "replaced-by-deletion"
    assert [(note.rule, note.location is None) for note in plan.notes if note.rule == rule] == [(rule, False)]
    (report,) = api.run(api.compile_job(job)).recordings
    assert report.exit_code == 0
    assert len([finding for finding in report.findings if f"[{rule}]" in finding]) == 1
    assert speeds(tmp_path) == [2]
    write_job(sequence=SKIP, **to(port))
    assert ran("run", job)[0] == 0
    assert speeds(tmp_path) == [2]


def test_server_append_adds_new_topics_once(
    write_bag: WriteBag, write_job: WriteJob, tmp_path: Path, port: int
) -> None:
    write_bag({"/speed": [number(1)], "/height": [number(3)]})
    add = {"name": "drive", "if_exists": "append"}
    job = write_job(sequence=add, topics=["/speed"], **to(port))
    assert ran("run", job)[0] == 0
    write_job(sequence=add, topics=["/height"], **to(port))
    assert ran("run", job)[0] == 0
    assert (speeds(tmp_path), speeds(tmp_path, "/height")) == ([1], [3])
    code, output = ran("run", job)
    assert code == 1
    assert "the server cannot append rows" in " ".join(output.split())
    assert (speeds(tmp_path), speeds(tmp_path, "/height")) == ([1], [3])


def kill_and_look(job: Path, folder: Path, rounds: int) -> tuple[int, int]:
    """Kill the first run of a job at random moments and repeat it; return how many kills left a complete sequence, and how many none."""
    moments = random.Random()  # noqa: S311 - any moment will do
    began = time.monotonic()
    assert ran("run", job)[0] == 0
    took = time.monotonic() - began
    assert ran("store", "rm", "drive", "--yes", "--store", folder / "served")[0] == 0
    whole = nothing = 0
    for _ in range(rounds):
        process = subprocess.Popen(  # noqa: S603 - our own command
            command("run", "-q", job), stderr=subprocess.DEVNULL, start_new_session=True
        )
        try:
            process.wait(took * (0.3 + 0.8 * moments.random()))
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait(timeout=20)
        store = Store.open(folder / "served")
        rows = store.sequence("drive").rows if "drive" in store.names() else 0
        assert rows in {0, ROWS}, "a reader sees all of it or nothing"
        whole, nothing = whole + (rows == ROWS), nothing + (rows == 0)
        code, output = ran("run", job)
        assert code == 0, output
        # Without rows the server may have received the last request, and commits after the store was read.
        assert rows == 0 or "it already has the same content" in output
        assert speeds(folder) == [1.0] * ROWS
        assert ran("run", job)[0] == 0
        assert ran("store", "rm", "drive", "--yes", "--store", folder / "served")[0] == 0
    return whole, nothing


def test_server_run_killed_leaves_all_or_nothing_and_next_run_completes(
    write_bag: WriteBag, write_job: WriteJob, tmp_path: Path, port: int
) -> None:
    write_bag({"/speed": [number(1)] * ROWS})
    _, nothing = kill_and_look(write_job(sequence=SKIP, **to(port)), tmp_path, 6)
    assert nothing, "the moments were not where they matter"


def test_server_replacement_killed_leaves_old_new_or_nothing_and_next_run_completes(
    write_bag: WriteBag, write_job: WriteJob, tmp_path: Path, port: int
) -> None:
    moments = random.Random()  # noqa: S311 - any moment will do
    job = write_job(sequence={**SKIP, "if_exists": "replace"}, **to(port))
    write_bag({"/speed": [number(0)] * ROWS})
    assert ran("run", job)[0] == 0
    began = time.monotonic()
    assert ran("run", job)[0] == 0
    took = time.monotonic() - began
    for value in range(1, 7):
        (tmp_path / "drive.db3").unlink()
        write_bag({"/speed": [number(value)] * ROWS})
        process = subprocess.Popen(command("run", "-q", job), stderr=subprocess.DEVNULL)  # noqa: S603 - our own command
        try:
            process.wait(took * moments.uniform(0.4, 1.1))
        except subprocess.TimeoutExpired:
            process.kill()
        process.wait(timeout=20)
        store = Store.open(tmp_path / "served")
        rows = store.sequence("drive").rows if "drive" in store.names() else 0
        assert rows in {0, ROWS}
        assert not rows or speeds(tmp_path) in ([value - 1.0] * ROWS, [float(value)] * ROWS)
        code, said = ran("run", job)
        assert code == 0, said
        assert speeds(tmp_path) == [float(value)] * ROWS


def test_run_with_killed_server_fails_and_next_run_completes(
    write_bag: WriteBag, write_job: WriteJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1)] * ROWS})
    with serving(tmp_path) as (port, server):
        job = write_job(sequence=SKIP, **to(port))
        client = subprocess.Popen(  # noqa: S603 - our own command
            command("run", "-q", job), stderr=subprocess.PIPE, text=True
        )
        while not list((tmp_path / "served" / "staging").glob("*")) and client.poll() is None:
            time.sleep(0.01)
        server.kill()
        _, output = client.communicate(timeout=60)
    assert client.returncode == 1, output
    assert output.startswith("error: ")
    assert "Traceback" not in output
    with serving(tmp_path, port):
        code, output = ran("run", job)
        assert code == 0, output
        assert speeds(tmp_path) == [1.0] * ROWS
        assert "it already has the same content" in ran("run", job)[1]


class Forgetful(Proxy):
    """A proxy that drops all data after one request, disconnects, and then recovers if `mended`."""

    def __init__(self, port: int, word: bytes, *, mended: bool = True) -> None:
        self.word: bytes | None = word
        self.asked = threading.Event()
        self._mended = mended
        super().__init__(port)

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:  # type: ignore[override]  # it knows its line
        try:
            while data := source.recv(65536):
                if self.asked.is_set() and self.word:
                    continue
                sink.sendall(data)
                if self.word and self.word in data:
                    self.asked.set()
                    threading.Timer(1.0, self._recover).start()
            sink.shutdown(socket.SHUT_WR)
        except OSError:
            return

    def _recover(self) -> None:
        self.cut()
        self.word = None
        if self._mended:
            self.restore()


@pytest.mark.parametrize(
    ("if_exists", "word"),
    [("skip", b"sequence_create"), *((each, b"session_finalize") for each in ("skip", "append", "replace"))],
)
def test_server_run_with_lost_response_writes_nothing_twice(
    if_exists: str, *, word: bytes, write_bag: WriteBag, write_job: WriteJob, tmp_path: Path, port: int
) -> None:
    write_bag({"/speed": [number(1), number(2)]})
    line = Forgetful(port, word)
    job = write_job(sequence={**SKIP, "if_exists": if_exists}, **to(line.port))
    code, output = ran("run", job)
    assert line.asked.is_set()
    assert code == 0, output
    assert speeds(tmp_path) == [1, 2]


@pytest.mark.parametrize("if_exists", ["skip", "append", "replace"])
def test_run_killed_before_response_to_commit_is_skipped_by_the_next(
    if_exists: str, write_bag: WriteBag, write_job: WriteJob, tmp_path: Path, port: int
) -> None:
    write_bag({"/speed": [number(1), number(2)]})
    line = Forgetful(port, b"session_finalize", mended=False)
    sequence = {**SKIP, "if_exists": if_exists}
    job = write_job(sequence=sequence, **to(line.port))
    process = subprocess.Popen(command("run", "-q", job), stderr=subprocess.DEVNULL)  # noqa: S603 - our own command
    assert line.asked.wait(30)
    time.sleep(0.3)
    process.kill()
    process.wait(timeout=20)
    assert speeds(tmp_path) == [1, 2]
    code, output = ran("run", write_job(sequence=sequence, **to(port)))
    assert code == (1 if if_exists == "append" else 0), output
    assert speeds(tmp_path) == [1, 2]


def test_replay_of_topic_without_rows_appends_it_once(
    write_bag: WriteBag, write_job: WriteJob, tmp_path: Path, port: int
) -> None:
    write_bag({"/speed": [number(1), number(2)], "/std/speed": [number(3)]})
    kept: dict[str, Any] = {"quarantine": {}, **to(port)}
    assert ran("run", "-q", write_job(definition="float64 data\nfloat64 more", **kept))[0] == 4
    replay = ("replay", "-q", tmp_path / "quarantine", "-m", write_job(**kept))
    assert ran(*replay)[0] == 0
    assert (speeds(tmp_path), speeds(tmp_path, "/std/speed")) == ([1, 2], [3])
    for result in (tmp_path / "quarantine").glob("*.replayed"):
        result.rename(result.with_suffix(""))  # as where the replay was killed before it could say so
    code, output = ran(*replay)
    assert code == 1
    assert "the server cannot append rows" in " ".join(output.split())
    assert speeds(tmp_path) == [1, 2]
