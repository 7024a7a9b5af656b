"""Rejected messages are kept in quarantine, within limits, and are replayed after the cause is fixed."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from mosaico_ingest.cli.app import main
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.report.events import RunStatus, TopicStatus
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.recording import open_recording

from .conftest import CUT, START_NS, RunJob, WriteBag, number

WriteJob = Callable[..., Path]


def kept(folder: Path) -> list[dict[str, object]]:
    """Check that the index matches its messages, and return the entries of the index."""
    entries: list[dict[str, object]] = []
    for index in sorted(folder.glob("*.jsonl")):
        lines = [json.loads(line) for line in index.read_text().splitlines()]
        own = [("own_msgs", folder.parent / "definitions", None)]
        with open_recording(index.with_suffix(".mcap"), resolve=TypeResolver(None, own)) as recording:
            actual = {
                (recording.connections[batch.connection].topic, int(time), int(length))
                for batch in recording.message_blocks()
                for time, length in zip(batch.log_times, batch.lengths, strict=True)
            }
            assert recording.message_count == len(lines)
        assert actual == {(line["topic"], line["log_time_ns"], line["bytes"]) for line in lines}
        entries += lines
    return entries


def test_quarantine_keeps_bytes_and_reason_of_rejected_message(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1), CUT, number(3)]})
    report = run_job(write_job(quarantine={}))
    assert report.status is RunStatus.WITH_ERRORS
    (topic,) = report.topics
    assert (topic.read, topic.written, topic.rejected, topic.quarantined) == (3, 2, 1, 1)
    (entry,) = kept(tmp_path / "quarantine")
    assert entry["log_time_ns"] == START_NS + 10_000_000
    assert (entry["sequence"], entry["topic"], entry["stage"]) == ("drive", "/speed", "decode")
    assert entry["reason"] == topic.rejections[0].reason
    assert any("ingest replay" in finding for finding in report.findings)
    assert report.quarantine is not None
    assert Path(report.quarantine).resolve() in (tmp_path / "quarantine").resolve().iterdir()


def test_quarantine_without_rejected_messages_creates_no_file(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1)]})
    assert run_job(write_job(quarantine={})).status is RunStatus.COMPLETED
    assert not (tmp_path / "quarantine").exists()


@pytest.mark.parametrize("case", [(2, 2), ("0.5%", 1), ("20 %", 4), (0, 0)])
def test_quarantine_beyond_limit_applies_topic_policy(
    case: tuple[object, int], write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    limit, aside = case
    write_bag({"/speed": [number(0), *[CUT] * 10, *map(number, range(9))]})
    job = write_job(quarantine={"max": limit}, on_error={"topic": "finalize"})
    (topic,) = run_job(job).topics
    assert topic.status is TopicStatus.FINALIZED
    assert (topic.read, topic.written, topic.rejected, topic.quarantined) == (20, 1, 19, aside)
    folder = tmp_path / "quarantine"
    assert len(kept(folder)) == aside


def test_quarantine_run_limit_counts_all_topics(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/a": [number(1), CUT, CUT], "/b": [number(1), CUT, CUT]})
    report = run_job(write_job(quarantine={"max_run": 3}, on_error={"topic": "ignore"}))
    assert sum(topic.quarantined for topic in report.topics) == 3
    assert report.totals.rejected == 4
    assert len(kept(tmp_path / "quarantine")) == 3


@pytest.mark.parametrize("policy", ["ignore", "finalize"])
def test_quarantine_topic_failing_from_its_start_ends(
    policy: str, write_bag: WriteBag, write_job: WriteJob, run_job: RunJob
) -> None:
    write_bag({"/bad": [CUT] * 30, "/good": [number(1)] * 5})
    report = run_job(write_job(quarantine={"systematic": 10}, on_error={"topic": policy}))
    bad, good = sorted(report.topics, key=lambda topic: topic.target)
    assert (bad.status, bad.read, bad.rejected, bad.quarantined) == (TopicStatus.FINALIZED, 30, 30, 10)
    assert bad.error is not None
    assert "all of the first 10 messages failed" in bad.error
    assert (good.written, good.rejected) == (5, 0)


def test_replay_with_fixed_definition_appends_messages(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(value) for value in range(5)], "/std/speed": [number(1)]})
    report = run_job(write_job(definition="float64 data\nfloat64 more", quarantine={}))
    assert (report.status, report.totals.rejected) == (RunStatus.WITH_ERRORS, 5)
    store, folder = Store.open(tmp_path / "store"), tmp_path / "quarantine"
    assert len(kept(folder)) == 5
    job = write_job(quarantine={})
    with pytest.raises(SystemExit) as ended:
        main(["replay", "-q", str(folder), "-m", str(job)])
    assert ended.value.code == 0
    assert store.scan("drive", "/speed").read_all()["data"].to_pylist() == list(range(5))
    assert store.sequence("drive").rows == 6
    with pytest.raises(SystemExit) as ended:
        main(["replay", "-q", str(folder), "-m", str(job)])
    assert ended.value.code == 3, "there is nothing to replay any more"
    assert store.sequence("drive").rows == 6


def test_replay_keeps_messages_that_fail_again(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(0), CUT], "/std/speed": [number(1)]})
    run_job(write_job(definition="float64 data\nfloat64 more", quarantine={}))
    folder = tmp_path / "quarantine"
    job = write_job(quarantine={})
    for left in (4, 1):
        with pytest.raises(SystemExit) as ended:
            main(["replay", "-q", str(folder), "-m", str(job)])
        assert ended.value.code == left
        (entry,) = kept(folder)
        assert entry["bytes"] == len(CUT)
    assert Store.open(tmp_path / "store").sequence("drive").rows == 2


def test_replacing_run_retires_quarantine_of_old_sequence(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1), CUT]})
    job = write_job(quarantine={}, sequence={"name": "drive", "if_exists": "replace"})
    run_job(job)
    for suffix in (".mcap", ".jsonl"):  # somebody else's files, which say nothing of a sequence
        (tmp_path / "quarantine" / f"foreign{suffix}").write_bytes(b"\xff\xfe")
    assert run_job(job).exit_code == 4
    assert len(list((tmp_path / "quarantine").glob("drive*.mcap"))) == 1


def test_replay_of_empty_quarantine_exits_3(
    write_bag: WriteBag, write_job: WriteJob, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_bag({"/speed": [number(1)]})
    with pytest.raises(SystemExit) as ended:
        main(["replay", str(tmp_path), "-m", str(write_job())])
    assert ended.value.code == 3
    assert "nothing to replay" in capsys.readouterr().err
