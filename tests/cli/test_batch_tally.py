"""What is said of a batch while it goes: by size, without what was skipped, and the same to people and programs."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from mosaico_ingest.cli.logs import JsonLines
from mosaico_ingest.cli.progress import BatchBoard, BatchLines, Tally, headline, sizes_of
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.report.events import (
    Expected,
    RunFinished,
    RunStarted,
    RunStatus,
    TopicProgress,
)


def started(name: str, promised: int = 100) -> RunStarted:
    topic = Expected("/a", "/a", "std_msgs/msg/String", "StringAdapter", "String", "", promised)
    return RunStarted(name, "store", (f"{name}.mcap",), 1000, (topic,))


@pytest.fixture
def tally(monkeypatch: pytest.MonkeyPatch) -> Tally:
    """A batch of three recordings, ten seconds after it began."""
    monkeypatch.setattr("mosaico_ingest.cli.progress.time.monotonic", lambda: 10.0)
    return Tally([1000, 8000, 1000], began=0.0)


def test_a_large_recording_counts_for_more(tally: Tally) -> None:
    tally.add(0, started("a"))
    tally.add(0, TopicProgress("/a", read=100, payload_bytes=1000))
    tally.add(0, RunFinished(RunStatus.COMPLETED, 0))
    tally.add(1, started("b"))
    tally.add(1, TopicProgress("/a", read=50, payload_bytes=5000))
    assert tally.share == 0.5
    assert tally.left_s == 10.0
    assert headline(tally) == "1 of 3 recordings, 150 messages, 15 msg/s, 600 B/s, 10.00 s left"


def test_what_was_skipped_or_failed_at_once_says_nothing_of_the_speed(tally: Tally) -> None:
    tally.add(1, started("b"))
    tally.add(1, RunFinished(RunStatus.SKIPPED, 0))
    assert tally.left_s is None
    assert headline(tally) == "1 of 3 recordings"
    tally.add(0, started("a"))
    tally.add(0, TopicProgress("/a", read=100))
    tally.add(0, RunFinished(RunStatus.COMPLETED, 0))
    assert tally.left_s == 10.0


def test_a_recording_that_is_begun_again_is_counted_once(tally: Tally) -> None:
    for _ in range(2):
        tally.add(0, started("a"))
        tally.add(0, TopicProgress("/a", read=70))
    assert (tally.read, tally.done) == (70, 0)
    tally.add(0, RunFinished(RunStatus.FAILED, 1, "it died"))
    assert (tally.read, tally.done, tally.failed, tally.at_work) == (70, 1, 1, {})


def test_people_see_what_is_in_work_and_programs_the_same(
    tally: Tally, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("mosaico_ingest.cli.logs.PROGRESS_EVERY_S", 0.0)
    say = JsonLines(tally)
    say(1, started("b"))
    say(1, TopicProgress("/a", read=25, payload_bytes=2000))
    progress = json.loads(capsys.readouterr().err.splitlines()[-1])
    assert (progress["event"], progress["sequence"], progress["read"]) == ("progress", "b", 25)
    assert progress["batch"] == {
        "recordings": 3,
        "done": 0,
        "failed": 0,
        "in_work": ["b"],
        "read": 25,
        "rejected": 0,
        "payload_bytes": 2000,
        "elapsed_s": 10.0,
        "left_s": 40.0,
    }
    console = Console(file=io.StringIO(), width=100)
    console.print(BatchBoard(tally).render())
    assert isinstance(console.file, io.StringIO)
    lines = console.file.getvalue().splitlines()
    assert lines[0].split() == ["recording", "read", "of", "rejected"]
    assert lines[1].split() == ["b", "25", "100", "0"]
    assert lines[2].startswith("0 of 3 recordings, 25 messages")


def test_a_plain_log_has_a_line_now_and_then(tally: Tally, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mosaico_ingest.cli.progress.LINE_EVERY_S", 0.0)
    console = Console(file=io.StringIO(), width=100)
    say = BatchLines(console, tally)
    say(0, started("a"))
    say(0, RunFinished(RunStatus.FAILED, 1, "it is empty"))
    assert isinstance(console.file, io.StringIO)
    lines = console.file.getvalue().splitlines()
    assert lines[-2:] == ["a: failed: it is empty", "1 of 3 recordings, 1 failed"]


def test_recordings_count_by_their_size_and_alike_where_one_is_not_known(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"x" * 10)
    (tmp_path / "b").mkdir()
    (tmp_path / "b/0.db3").write_bytes(b"x" * 20)
    (tmp_path / "b/metadata.yaml").write_bytes(b"x" * 5)
    configs = [
        ROSInjectionConfig(file_path=tmp_path / name, sequence_name=name.partition(".")[0])
        for name in ("a.mcap", "b", "gone.mcap")
    ]
    assert sizes_of(configs[:2]) == [10, 25]
    assert sizes_of(configs) == [1, 1, 1]
    assert sizes_of([ROSInjectionConfig(file_path="s3://bucket/a.mcap", sequence_name="a")]) == [1]
