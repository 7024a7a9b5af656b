"""The watcher as a process: slow copies, stop signals and kills during an ingest."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from mosaico_ingest.destinations.store import Store

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
DRIVE = ROOT / "configs" / "quickstart" / "drive.mcap"
UNIT = ROOT / "configs" / "scale" / "ingest-watch.service"
PATIENCE_S = 60.0


@dataclass
class Watch:
    """A watcher process in a folder; its output goes to a file, since a full pipe would block it."""

    folder: Path
    started: list[subprocess.Popen[bytes]] = field(default_factory=list[subprocess.Popen[bytes]])

    def start(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "mosaico_ingest", "watch", "in", "job.yaml"]
        with (self.folder / "said.txt").open("ab") as output:
            process = subprocess.Popen(  # noqa: S603 - our own command
                [*command, "--rest", "0.5", "--every", "0.1"],
                cwd=self.folder,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )
        self.started.append(process)
        self.until(lambda: self.said().count("watching in\n") == len(self.started))
        return process

    def said(self) -> str:
        return (self.folder / "said.txt").read_text()

    def until(self, happened: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not happened():
            assert time.monotonic() < deadline, self.said()
            time.sleep(0.02)

    def names(self) -> tuple[str, ...]:
        return Store.open(self.folder / "store").names()


@pytest.fixture
def watch(tmp_path: Path) -> Iterator[Watch]:
    (tmp_path / "in").mkdir()
    (tmp_path / "job.yaml").write_text(
        'bag: {path: "none/*.mcap"}\nsequence: {name: "{stem}"}\ntopics: [/imu]\ntarget: {store: store}\n'
    )
    watching = Watch(tmp_path)
    yield watching
    for process in watching.started:
        for child in children(process.pid):
            with suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait(10)


def children(pid: int) -> list[int]:
    with suppress(OSError):
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return []


def test_watch_ingests_renamed_file_immediately_and_slow_copy_after_rest(watch: Watch) -> None:
    whole = DRIVE.read_bytes()
    watch.start()
    (watch.folder / "in" / ".a.mcap.part").write_bytes(whole)
    (watch.folder / "in" / ".a.mcap.part").rename(watch.folder / "in" / "a.mcap")
    for step in range(6):
        with (watch.folder / "in" / "slow.mcap").open("ab") as copying:
            copying.write(whole[step * len(whole) // 6 : (step + 1) * len(whole) // 6])
        time.sleep(0.25)
    watch.until(lambda: "slow.mcap: " in watch.said() and "a.mcap: " in watch.said())
    lines = watch.said().splitlines()
    assert sorted(line.split(" ", 1)[1].partition(",")[0] for line in lines) == [
        "in/a.mcap: completed as a",
        "in/slow.mcap: completed as slow",
        "watching in",
    ]
    assert set(watch.names()) == {"a", "slow"}


def test_watch_evaluates_group_of_all_complete_recordings(watch: Watch) -> None:
    with (watch.folder / "job.yaml").open("a") as manifest:
        manifest.write('expect: {group: {files: ["a.mcap", "b.mcap"], starts: {within: 1 s}}}\n')
    shutil.copy(DRIVE, watch.folder / "in" / "a.mcap")
    watch.start()
    watch.until(lambda: "in/a.mcap: failed" in watch.said())
    assert "no file for 'b.mcap' among 1 recording" in watch.said()
    shutil.copy(DRIVE, watch.folder / "in" / "b.mcap")
    watch.until(lambda: "in/b.mcap: completed as b" in watch.said())


def test_watch_stopped_by_signal_exits_0(watch: Watch) -> None:
    process = watch.start()
    process.send_signal(signal.SIGTERM)
    assert process.wait(PATIENCE_S) == 0
    assert watch.said().splitlines()[-1].endswith("stopped watching")


@pytest.mark.skipif(sys.platform != "linux", reason="finds the process at work in /proc")
def test_watch_restarted_after_kill_ingests_interrupted_recording_exactly_once(watch: Watch) -> None:
    shutil.copy(DRIVE, watch.folder / "in" / "a.mcap")
    first = watch.start()
    watch.until(lambda: "a.mcap: completed" in watch.said())
    shutil.copy(DRIVE, watch.folder / "in" / "b.mcap")
    staging = watch.folder / "store" / "staging"
    watch.until(lambda: (staging.is_dir() and any(staging.iterdir())) or "b.mcap: completed" in watch.said())
    workers = children(first.pid)
    for pid in (first.pid, *workers):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    first.wait(10)
    before = len(watch.said().splitlines())
    watch.start()
    watch.until(lambda: sum("b.mcap: " in line for line in watch.said().splitlines()[before:]) == 1)
    after = "\n".join(watch.said().splitlines()[before:])
    assert "in/a.mcap: skipped as a" in after
    assert "in/b.mcap: failed" not in after
    assert watch.names() == ("a", "b")
    for name in watch.names():
        assert [topic.rows for topic in Store.open(watch.folder / "store").sequence(name).topics] == [1000]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not here")
def test_systemd_unit_is_valid(tmp_path: Path) -> None:
    text = UNIT.read_text().replace("/srv/ingest/.venv/bin/ingest", sys.executable)
    (tmp_path / UNIT.name).write_text(text)
    result = subprocess.run(  # noqa: S603 - the unit is ours
        ["systemd-analyze", "verify", str(tmp_path / UNIT.name)],  # noqa: S607 - wherever the system has it
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert UNIT.name not in result.stderr
