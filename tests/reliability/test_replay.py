"""A replay appends each quarantined message exactly once, wherever it is stopped, and keeps messages that fail again."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from mosaico_ingest import api
from mosaico_ingest.cli.app import main
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.pipeline.rejections import QuarantineFile
from mosaico_ingest.report.events import RunStatus
from mosaico_ingest.services.status import ReplayState, find_replays, lock_quarantine

from .conftest import CUT, RunJob, WriteBag, number

WriteJob = Callable[..., Path]
WRONG = "float64 data\nfloat64 more"
_STORE = "mosaico_ingest.destinations.store.destination"
MOMENTS = {
    "before the commit": (f"{_STORE}.StoreDestination", "commit", "before"),
    "segments moved, not entered": ("mosaico_ingest.destinations.store.files.LocalFiles", "publish", "after"),
    "committed": (f"{_STORE}.StoreDestination", "commit", "after"),
    "committed and checked": ("mosaico_ingest.destinations.store.session.StoreSession", "stored", "after"),
    "before it is marked": ("mosaico_ingest.pipeline.rejections.QuarantineFile", "mark_replayed", "before"),
    "messages renamed, their index not": ("pathlib.Path", "rename", "after"),
    "marked": ("mosaico_ingest.pipeline.rejections.QuarantineFile", "mark_replayed", "after"),
}
_KILLED = """
import importlib, os, signal, sys
module, name = sys.argv[1].rsplit(".", 1)
owner = getattr(importlib.import_module(module), name)
method, moment = sys.argv[2:4]
plain = getattr(owner, method)
def deadly(self, *given, **more):
    mine = method != "rename" or ".mcap" in str(self)
    if mine and moment == "before":
        os.kill(os.getpid(), signal.SIGKILL)
    done = plain(self, *given, **more)
    if mine:
        os.kill(os.getpid(), signal.SIGKILL)
    return done
setattr(owner, method, deadly)
from mosaico_ingest.cli.app import main
main(sys.argv[4:])
"""


def command(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


def killed(moment: str, *arguments: object) -> int:
    """Run the command in a process that is killed at the given step; return its exit code."""
    ran = subprocess.run(  # noqa: S603 - this interpreter, our own code
        [sys.executable, "-c", _KILLED, *MOMENTS[moment], *map(str, arguments)],
        check=False,
        timeout=60,
        capture_output=True,
    )
    return ran.returncode


def values(store: Store, topic: str = "/speed") -> list[float]:
    return sorted(store.scan("drive", topic).read_all()["data"].to_numpy().tolist())


def waiting(folder: Path, job: Path) -> int:
    """Return the number of messages that a replay processes."""
    entries = find_replays(folder, api.compile_job(job))
    files = [one.file.messages for one in entries if one.state is ReplayState.WAITING]
    return sum(len(path.with_suffix(".jsonl").read_text().splitlines()) for path in files)


@pytest.fixture
def spoilt(write_bag: WriteBag, write_job: WriteJob, run_job: RunJob) -> Path:
    """A fixed job, and its sequence of one stored and six quarantined messages, one of which always fails."""
    write_bag({"/speed": [*map(number, range(5)), CUT], "/std/speed": [number(1)]})
    report = run_job(write_job(definition=WRONG, quarantine={}))
    assert (report.status, report.totals.written, report.totals.rejected) == (RunStatus.WITH_ERRORS, 1, 6)
    return write_job(quarantine={})


@pytest.mark.slow
@pytest.mark.parametrize("moment", MOMENTS)
def test_replay_killed_at_any_step_appends_each_message_once(
    moment: str, spoilt: Path, tmp_path: Path
) -> None:
    folder, store = tmp_path / "quarantine", Store.open(tmp_path / "store")
    replay = ("replay", "-q", folder, "-m", spoilt)
    assert killed(moment, *replay) == -9
    assert command(*replay) in {0, 1, 3, 4}
    assert values(store) == list(range(5))
    assert store.sequence("drive").rows == 6
    assert waiting(folder, spoilt) == 1
    assert command(*replay) == 1, "the remaining message does not fit"
    assert store.sequence("drive").rows == 6
    assert waiting(folder, spoilt) == 1


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["before the commit", "segments moved, not entered", "committed"])
def test_replay_after_killed_run_appends_only_to_its_sequence(
    moment: str, write_bag: WriteBag, write_job: WriteJob, tmp_path: Path
) -> None:
    write_bag({"/speed": list(map(number, range(5))), "/std/speed": [number(1)]})
    folder, store = tmp_path / "quarantine", tmp_path / "store"
    assert killed(moment, "run", "-q", write_job(definition=WRONG, quarantine={})) == -9
    if moment != "committed":
        assert command("run", "-q", write_job(definition=WRONG, quarantine={})) == 4
    assert command("replay", "-q", folder, "-m", write_job(quarantine={})) == 0
    assert values(Store.open(store)) == list(range(5))


def test_replay_stopped_before_marking_file_is_not_repeated(
    spoilt: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, store = tmp_path / "quarantine", Store.open(tmp_path / "store")
    with monkeypatch.context() as patched:
        patched.setattr(QuarantineFile, "mark_replayed", str)
        assert command("replay", "-q", folder, "-m", spoilt) == 4
    assert len(list(folder.glob("*.mcap"))) == 2, "the replayed messages, and the messages that failed again"
    assert command("replay", folder, "-m", spoilt) == 1
    assert "already in the sequence" in capsys.readouterr().err
    assert (values(store), waiting(folder, spoilt)) == (list(range(5)), 1)


def test_replay_of_orphaned_file_appends_nothing(
    spoilt: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, store = tmp_path / "quarantine", Store.open(tmp_path / "store")
    store.delete_sequence("drive")
    assert command("replay", folder, "-m", spoilt) == 3
    assert "the sequence does not contain the run" in capsys.readouterr().err
    assert "drive" not in store.names()
    without = yaml.safe_load(spoilt.read_text())
    del without["quarantine"]
    again = tmp_path / "again.yaml"
    again.write_text(yaml.safe_dump(without))
    assert command("run", "-q", again) == 4
    assert command("replay", "-q", folder, "-m", spoilt) == 3, "the new sequence has those messages already"
    assert (values(store), waiting(folder, spoilt)) == (list(range(5)), 0)


def test_replay_of_locked_quarantine_is_refused(
    spoilt: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "quarantine"
    with lock_quarantine(folder):
        assert command("replay", "-q", folder, "-m", spoilt) == 1
    assert "another replay" in capsys.readouterr().err
    assert command("replay", "-q", folder, "-m", spoilt) == 4
    assert not list(folder.glob(".replay*"))


def test_replay_quarantines_failing_messages_without_limit(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [*[CUT] * 9, *map(number, range(5))], "/std/speed": [number(1)]})
    run_job(write_job(definition=WRONG, quarantine={}))
    folder = tmp_path / "quarantine"
    strict = write_job(quarantine={"max": 2, "systematic": 3}, on_error={"topic": "finalize"})
    assert command("replay", "-q", folder, "-m", strict) == 4
    assert values(Store.open(tmp_path / "store")) == list(range(5))
    assert waiting(folder, strict) == 9


def test_replay_with_fixed_mapping_appends_messages(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    adapter = tmp_path / "speed.yaml"

    def mapping(data: object) -> None:
        mapped = {"version": 1, "adapter": "OwnSpeed", "ros_type": "own_msgs/msg/Number"}
        adapter.write_text(yaml.safe_dump({**mapped, "ontology": "Floating64", "fields": {"data": data}}))

    mapping({"value": "data", "map": {3: 3.0, 4: 4.0, 5: 5.0}, "else": "error"})
    write_bag({"/speed": [*map(number, range(6)), CUT]})
    job = write_job(quarantine={}, adapters={"load": ["speed.yaml"]})
    first = run_job(job)
    (topic,) = first.topics
    assert (topic.read, topic.written, topic.rejected, topic.quarantined) == (7, 3, 4, 4)
    mapping("data")
    folder, store, output = tmp_path / "quarantine", Store.open(tmp_path / "store"), tmp_path / "replay.json"
    assert command("replay", "-q", folder, "-m", job, "--report", output) == 4
    (replayed,) = json.loads(output.read_text())["recordings"][0]["topics"]
    assert (replayed["read"], replayed["written"], replayed["rejected"]) == (4, 3, 1)
    assert topic.written + replayed["written"] + replayed["quarantined"] == topic.read
    assert values(store) == list(range(6))
    assert waiting(folder, job) == 1
    assert command("verify", "drive", "--store", store.path) == 0


def test_replay_with_other_columns_changes_nothing(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1), CUT], "/std/speed": [number(1)]})
    run_job(write_job(quarantine={}))
    folder = tmp_path / "quarantine"
    other = write_job(definition="uint8 data", quarantine={}, on_error={"topic": "ignore"})
    assert command("replay", "-q", folder, "-m", other) != 0
    assert values(Store.open(tmp_path / "store")) == [1]
    assert waiting(folder, other) == 1


def test_replay_that_cannot_rename_file_fails_and_appends_once(
    spoilt: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, store = tmp_path / "quarantine", Store.open(tmp_path / "store")
    (messages,) = folder.glob("*.mcap")
    in_the_way = folder / f"{messages.name}.replayed"
    in_the_way.mkdir()
    for code in (1, 1):
        assert command("replay", "-q", folder, "-m", spoilt) == code
        error = capsys.readouterr().err
        assert error.startswith("error: ")
        assert "cannot be marked as replayed" in error
        assert values(store) == list(range(5))
    in_the_way.rmdir()
    assert command("replay", "-q", folder, "-m", spoilt) == 1, "the remaining message does not fit"
    assert values(store) == list(range(5))


@pytest.mark.parametrize(
    "content", [None, '{"sequence": "drive"\n', "[1]\n", '{"topic": "/speed"}\n', b"\xff\xfe\n"]
)
def test_replay_of_folder_without_quarantine_fails_with_one_error(
    content: str | bytes | None, spoilt: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("replay", "-q", tmp_path / "nowhere", "-m", spoilt) == 3
    assert "the folder does not exist" in capsys.readouterr().err
    (index,) = (tmp_path / "quarantine").glob("*.jsonl")
    index.unlink()
    if content is not None:
        index.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert command("replay", "-q", tmp_path / "quarantine", "-m", spoilt) == 1
    error = capsys.readouterr().err
    assert "not the index of a quarantine" in error
    assert str(index) in error


def test_replay_of_sequence_not_in_manifest_names_it(
    spoilt: Path, write_job: WriteJob, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = write_job(quarantine={}, sequence={"name": "other"}, file="other.yaml")
    assert command("replay", "-q", tmp_path / "quarantine", "-m", other) == 2
    error = capsys.readouterr().err
    assert "belongs to the sequence 'drive'" in error
    assert "defines other" in error
    assert waiting(tmp_path / "quarantine", spoilt) == 6


def test_replay_after_run_killed_before_first_message_finds_nothing(spoilt: Path, tmp_path: Path) -> None:
    (index,) = (tmp_path / "quarantine").glob("*.jsonl")
    index.write_text('{"sequence": "dr')
    assert command("replay", "-q", tmp_path / "quarantine", "-m", spoilt) == 3


def test_replay_of_removed_sequence_appends_nothing(
    spoilt: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Store.open(tmp_path / "store").delete_sequence("drive")
    assert command("replay", tmp_path / "quarantine", "-m", spoilt) == 3
    assert "the sequence does not contain the run" in capsys.readouterr().err
