"""The watcher ingests each recording exactly once, after its file stops changing."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest
from made_recordings import define, record

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.pipeline.run import run_recording
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.report.events import RunStatus
from mosaico_ingest.services.status import recording_statuses
from mosaico_ingest.services.watch import Arrivals, is_unfinished

_fcntl = import_module("fcntl") if find_spec("fcntl") else None
DRIVE = Path(__file__).resolve().parents[2] / "configs" / "quickstart" / "drive.mcap"
JOB = 'bag: {path: "nothing/*.mcap"}\ntopics: [/imu]\ntarget: {store: store}\n'


def test_arrivals_file_settles_once_until_it_changes(tmp_path: Path) -> None:
    arrivals = Arrivals(tmp_path, rest_s=5)
    file = tmp_path / "a.mcap"
    file.write_bytes(b"1")
    assert arrivals.settled(0) == ()
    file.write_bytes(b"12")
    assert arrivals.settled(5) == ()
    assert arrivals.settled(10) == (file,)
    assert arrivals.settled(20) == ()
    file.write_bytes(b"123")
    assert arrivals.settled(30) == ()
    assert arrivals.settled(35) == (file,)


def test_arrivals_hidden_empty_and_other_files_are_ignored(tmp_path: Path) -> None:
    (tmp_path / ".a.mcap.Xy12").write_bytes(b"1")
    (tmp_path / "b.mcap").touch()
    (tmp_path / "notes.txt").write_bytes(b"1")
    arrivals = Arrivals(tmp_path, rest_s=0)
    assert arrivals.settled(0) == ()
    (tmp_path / ".a.mcap.Xy12").rename(tmp_path / "a.mcap")
    assert arrivals.settled(1) == (tmp_path / "a.mcap",)


def test_arrivals_link_to_parent_folder_is_ignored(tmp_path: Path) -> None:
    (tmp_path / "day").mkdir()
    (tmp_path / "day" / "a.mcap").write_bytes(b"1")
    (tmp_path / "day" / "back").symlink_to(tmp_path, target_is_directory=True)
    assert Arrivals(tmp_path, rest_s=0).settled(0) == (tmp_path / "day" / "a.mcap",)


def test_arrivals_rosbag2_directory_settles_with_its_metadata(tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "drive"
    folder.mkdir(parents=True)
    (folder / "drive_0.mcap").write_bytes(b"1")
    arrivals = Arrivals(tmp_path, rest_s=0)
    assert arrivals.settled(0) == ()
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    assert arrivals.settled(1) == (folder,)


@pytest.mark.skipif(
    not hasattr(_fcntl, "F_SETLEASE"), reason="only Linux reports files that are open for writing"
)
def test_arrivals_file_open_for_writing_does_not_settle(tmp_path: Path) -> None:
    file = tmp_path / "a.mcap"
    arrivals = Arrivals(tmp_path, rest_s=0)
    with file.open("wb") as writing:
        writing.write(b"1")
        writing.flush()
        assert arrivals.settled(0) == ()
        assert arrivals.settled(9) == ()
    assert arrivals.settled(10) == (file,)


def test_arrivals_failed_recording_settles_again_with_doubled_delay(tmp_path: Path) -> None:
    file = tmp_path / "a.mcap"
    file.write_bytes(b"1")
    arrivals = Arrivals(tmp_path, rest_s=0)
    assert arrivals.settled(0) == (file,)
    assert arrivals.again(file, 0) == 60
    assert arrivals.settled(59) == ()
    assert arrivals.settled(60) == (file,)
    assert arrivals.again(file, 60) == 120
    assert arrivals.settled(179) == ()


def unfinished_mcap(folder: Path) -> tuple[Path, bytes]:
    """Write the first half of a recording, and return its path and the rest."""
    content = DRIVE.read_bytes()
    file = folder / "a.mcap"
    file.write_bytes(content[: len(content) // 2])
    return file, content[len(content) // 2 :]


def test_arrivals_unfinished_recording_settles_after_longer_rest(tmp_path: Path) -> None:
    file, rest = unfinished_mcap(tmp_path)
    arrivals = Arrivals(tmp_path, rest_s=5)
    assert [arrivals.settled(now) for now in (0, 10, 100)] == [(), (), ()]
    assert arrivals.unfinished() == (file,)
    an_hour_ago = time.time() - 3600
    os.utime(file, (an_hour_ago, an_hour_ago))
    assert arrivals.settled(110) == ()
    assert arrivals.settled(120) == (file,)
    with file.open("ab") as appended:
        appended.write(rest)
    assert arrivals.settled(130) == ()
    assert arrivals.settled(140) == (file,)
    assert arrivals.unfinished() == ()


@pytest.mark.parametrize("name", ["drive.bag", "drive.mcap", "drive.db3"])
def test_is_unfinished_is_true_until_the_last_byte(name: str, tmp_path: Path) -> None:
    number = define("std_msgs/msg/Int32", "int32 data\n", version=1 if name == "drive.bag" else 2)
    messages = [("/number", number, at, {"data": at}) for at in range(1000)]
    content = record(tmp_path / name, messages).read_bytes()
    file = tmp_path / f"part_{name}"
    for size in (len(content), len(content) - 1, len(content) // 2):
        file.write_bytes(content[:size])
        assert is_unfinished(file) == (size < len(content)), size


def test_run_of_recording_that_has_grown_replaces_sequence(tmp_path: Path) -> None:
    file, rest = unfinished_mcap(tmp_path)
    job = ROSInjectionConfig(
        file,
        "a",
        store=tmp_path / "store",
        topics=("/imu",),
        manifest={"sequence": {"if_exists": IfExists.SKIP}},
    ).job
    assert run_recording(Task(job)).report.status is RunStatus.WITH_ERRORS
    assert run_recording(Task(job)).report.status is RunStatus.SKIPPED
    with file.open("ab") as appended:
        appended.write(rest)
    assert [(one.status.value, one.reason) for one in recording_statuses([job])] == [
        ("changed", "the recording has grown since it was ingested")
    ]
    assert run_recording(Task(job)).report.status is RunStatus.COMPLETED
    assert Store.open(tmp_path / "store").sequence("a").rows == 1000
    content = bytearray(file.read_bytes())
    content[1000] ^= 1
    file.write_bytes(content + b"more")
    assert run_recording(Task(job)).report.exit_code == 1, "other content does not replace the sequence"


STRICT = os.environ | {"PYTHONIOENCODING": "utf-8:strict"}
"""An environment with strict UTF-8 standard output, as in most locales: it rejects file names that are not UTF-8."""


def watch_once(folder: Path, *options: str, code: int = 0) -> list[str]:
    command = [sys.executable, "-m", "mosaico_ingest", "watch", "in", "job.yaml", "--once"]
    pace = ["--rest", "0.2", "--every", "0.1"]
    result = subprocess.run(  # noqa: S603 - our own command
        [*command, *pace, *options],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
        env=STRICT,
    )
    assert result.returncode == code, result.stderr
    return result.stdout.splitlines()


@pytest.mark.slow
def test_watch_once_ingests_recordings_and_skips_them_again(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "job.yaml").write_text(JOB)
    shutil.copy(DRIVE, tmp_path / "in" / "a.mcap")
    assert "in/a.mcap: completed as a, 1,000 messages" in watch_once(tmp_path)[1]
    (tmp_path / "in" / "c.mcap").write_bytes(b"torn")
    lines = watch_once(tmp_path, code=1)
    assert "in/a.mcap: skipped as a" in lines[1]
    assert "in/c.mcap: failed as c" in lines[2]
    assert "tried again" not in lines[2]
    assert Store.open(tmp_path / "store").names() == ("a",)


@pytest.mark.slow
def test_watch_once_ingests_unfinished_recording_only_after_its_rest(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "job.yaml").write_text(JOB)
    content = DRIVE.read_bytes()
    (tmp_path / "in" / "a.mcap").write_bytes(content[: len(content) // 2])
    lines = watch_once(tmp_path, code=4)
    assert "in/a.mcap: not ingested" in lines[1]
    assert not (tmp_path / "store").exists()
    lines = watch_once(tmp_path, "--unfinished-rest", "0", code=4)
    assert "in/a.mcap: completed_with_errors as a" in lines[1]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_watch_file_with_unprintable_name_is_ingested_and_escaped(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "job.yaml").write_text(JOB)
    for name in (b"bad\xff.mcap", b"red\x1b[31m.mcap"):
        shutil.copy(DRIVE, tmp_path / "in" / os.fsdecode(name))
    lines = watch_once(tmp_path)
    assert sum(": completed as " in line for line in lines) == 2
    assert "\x1b" not in "".join(lines)
