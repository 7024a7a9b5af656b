"""Progress of a batch: weighted by size, estimated without skipped recordings, and equal in all displays."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console
from rich.text import Text

from mosaico_ingest.cli.progress import (
    JsonLines,
    LiveTable,
    Tally,
    TextLines,
    headline,
    recording_sizes,
)
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.report.events import (
    Expected,
    Noted,
    RunFinished,
    RunStarted,
    RunStatus,
    TopicProgress,
    Unreadable,
)


def started(name: str, promised: int = 100) -> RunStarted:
    topic = Expected("/a", "/a", "std_msgs/msg/String", "StringAdapter", "String", "", promised)
    return RunStarted(name, "store", (f"{name}.mcap",), 1000, (topic,))


@pytest.fixture
def tally(monkeypatch: pytest.MonkeyPatch) -> Tally:
    """A batch of three recordings, ten seconds after it began."""
    monkeypatch.setattr("mosaico_ingest.cli.progress.time.monotonic", lambda: 10.0)
    return Tally([1000, 8000, 1000], started=0.0)


def test_tally_recordings_of_different_size_weighted_by_size(tally: Tally) -> None:
    tally.add(0, started("a"))
    tally.add(0, TopicProgress("/a", read=100, payload_bytes=1000))
    tally.add(0, RunFinished(RunStatus.COMPLETED, 0))
    tally.add(1, started("b"))
    tally.add(1, TopicProgress("/a", read=50, payload_bytes=5000))
    assert tally.share == 0.5
    assert tally.remaining_s == 10.0
    assert headline(tally) == (
        "1 of 3 recordings, 150 messages, 50 %, 15 msg/s, 600 B/s, 10.00 s elapsed, 10.00 s left"
    )


def test_tally_skipped_recording_does_not_affect_estimate(tally: Tally) -> None:
    tally.add(1, started("b"))
    tally.add(1, RunFinished(RunStatus.SKIPPED, 0))
    assert tally.remaining_s is None
    assert headline(tally) == "1 of 3 recordings"
    tally.add(0, started("a"))
    tally.add(0, TopicProgress("/a", read=100))
    tally.add(0, RunFinished(RunStatus.COMPLETED, 0))
    assert tally.remaining_s == 10.0


def test_tally_restarted_recording_counts_once(tally: Tally) -> None:
    for _ in range(2):
        tally.add(0, started("a"))
        tally.add(0, TopicProgress("/a", read=70))
    assert (tally.read, tally.finished) == (70, 0)
    tally.add(0, RunFinished(RunStatus.FAILED, 1, "it died"))
    assert (tally.read, tally.finished, tally.failed, tally.active) == (70, 1, 1, {})


def test_displays_active_recording_show_equal_counts(
    tally: Tally, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("mosaico_ingest.cli.progress.LINE_INTERVAL_S", 0.0)
    observe = JsonLines(tally)
    observe(1, started("b"))
    observe(1, TopicProgress("/a", read=25, payload_bytes=2000))
    progress = json.loads(capsys.readouterr().err.splitlines()[-1])
    assert (progress["event"], progress["sequence"], progress["read"]) == ("progress", "b", 25)
    assert progress["batch"] == {
        "recordings": 3,
        "finished": 0,
        "failed": 0,
        "active": ["b"],
        "read": 25,
        "rejected": 0,
        "payload_bytes": 2000,
        "elapsed_s": 10.0,
        "remaining_s": 40.0,
    }
    console = Console(file=io.StringIO(), width=100)
    console.print(LiveTable(tally).render())
    assert isinstance(console.file, io.StringIO)
    lines = console.file.getvalue().splitlines()
    assert lines[0].split() == ["recording", "read", "of", "rejected"]
    assert lines[1].split() == ["b", "25", "100", "0"]
    assert lines[2].startswith("0 of 3 recordings, 25 messages")


def test_text_lines_failed_recording_prints_error_and_totals(
    tally: Tally, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mosaico_ingest.cli.progress.LINE_INTERVAL_S", 0.0)
    console = Console(file=io.StringIO(), width=100)
    observe = TextLines(console, tally)
    observe(0, started("a"))
    observe(0, RunFinished(RunStatus.FAILED, 1, "it is empty"))
    assert isinstance(console.file, io.StringIO)
    lines = console.file.getvalue().splitlines()
    assert lines[-2:] == ["a: failed: it is empty", "1 of 3 recordings, 1 failed"]


def test_recording_sizes_one_unknown_returns_equal_sizes(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"x" * 10)
    (tmp_path / "b").mkdir()
    (tmp_path / "b/0.db3").write_bytes(b"x" * 20)
    (tmp_path / "b/metadata.yaml").write_bytes(b"x" * 5)
    jobs = [
        ROSInjectionConfig(file_path=tmp_path / name, sequence_name=name.partition(".")[0]).job
        for name in ("a.mcap", "b", "gone.mcap")
    ]
    assert recording_sizes(jobs[:2]) == [10, 25]
    assert recording_sizes(jobs) == [1, 1, 1]
    assert recording_sizes([ROSInjectionConfig(file_path="s3://bucket/a.mcap", sequence_name="a").job]) == [1]


def test_text_lines_name_with_line_break_prints_one_line() -> None:
    console = Console(file=io.StringIO(), width=100)
    observe = TextLines(console, Tally([1, 1]))
    observe(0, started("a\nerror: forged"))
    observe(0, Noted(Finding("note", Severity.INFO, "first\nerror: second")))
    observe(0, Unreadable("/t\nerror: third", 1, None, "damaged\x1b[2J"))
    assert isinstance(console.file, io.StringIO)
    lines = console.file.getvalue().splitlines()
    assert len(lines) == 2
    assert "\x1b" not in console.file.getvalue()
    assert not any(line.startswith("error") for line in lines)


@pytest.mark.promise("progress")
def test_live_table_single_recording_lists_its_topics(tally: Tally) -> None:
    tally = Tally([1], started=0.0)
    table = LiveTable(tally)
    table(0, started("a\nb"))
    table(0, TopicProgress("/a", read=25, written=20, payload_bytes=2000))
    console = Console(file=io.StringIO(), width=100)
    console.print(table.render())
    assert isinstance(console.file, io.StringIO)
    lines = console.file.getvalue().splitlines()
    assert lines[0].split() == ["topic", "ontology", "read", "written", "rejected"]
    assert lines[1].split() == ["/a", "String", "25", "20", "0"]
    assert lines[2].startswith("a\\nb: 25 of 100 messages")
    table(0, RunFinished(RunStatus.COMPLETED, 0))
    assert table.render() == Text("")
