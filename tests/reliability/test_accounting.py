"""Every message of an index is read or reported as unreadable, and stored rows equal written rows."""

from __future__ import annotations

import signal
import sqlite3
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from made_recordings import define, record
from store_formats import make_format_1

from mosaico_ingest import api
from mosaico_ingest.cli.app import main
from mosaico_ingest.destinations import Session, StoredTopic, TopicWriter
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.destinations.store.destination import StoreDestination
from mosaico_ingest.destinations.store.store import verify
from mosaico_ingest.errors import BagError, VerificationError
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.values import LoaderErrorPolicy
from mosaico_ingest.pipeline.pump import check_counts
from mosaico_ingest.pipeline.run import run_recording
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.pipeline.write_buffer import WriteBuffer
from mosaico_ingest.report.events import (
    Event,
    Noted,
    RunStatus,
    Unreadable,
)
from mosaico_ingest.rosbag.blocks import UnreadableRange

from .conftest import RunJob, WriteBag, number

WriteJob = Callable[..., Path]
DRIVE = Path(__file__).parents[2] / "configs" / "quickstart" / "drive.mcap"


def missing(
    promised: int | None, seen: int, unreadable: list[UnreadableRange], **plan: Any
) -> tuple[list[str], list[Event]]:
    events: list[Event] = []
    topic = SimpleNamespace(target="/t", count=promised, connections=(7,), shares_messages=False)
    recording: Any = SimpleNamespace(unreadable=unreadable)
    wanted: Any = SimpleNamespace(**{"read_from_ns": None, "read_until_ns": None, **plan})
    streams: Any = (SimpleNamespace(plan=topic, read=seen),)
    return check_counts(wanted, recording, streams, events.append), events


def test_check_counts_unexplained_difference_is_returned() -> None:
    wrong, events = missing(10, 8, [UnreadableRange(0, "bad", 7, 1, "f")])
    assert wrong == [
        "/t: the index promises 10 messages, 8 were read and no unreadable range explains the difference"
    ]
    assert not events


def test_check_counts_unknown_unreadable_range_explains_difference() -> None:
    wrong, events = missing(10, 8, [UnreadableRange(0, "bad", file="f")])
    assert not wrong
    assert events == [Unreadable("/t", 2, None, "the messages are in unreadable ranges")]
    assert missing(10, 8, [UnreadableRange(0, "bad", 7, 2, "f")]) == ([], [])


def test_check_counts_more_messages_than_promised_is_a_warning() -> None:
    wrong, (event,) = missing(10, 12, [])
    assert not wrong
    assert isinstance(event, Noted)
    assert event.finding.rule == "unexpected-messages"


def test_check_counts_ignores_time_range_and_unknown_count() -> None:
    assert missing(10, 1, [], read_from_ns=5) == ([], [])
    assert missing(None, 1, []) == ([], [])


def test_counts_of_damaged_recording_add_up(tmp_path: Path) -> None:
    data = bytearray(DRIVE.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 60_000] = bytes(60_000)
    bag = tmp_path / "drive.mcap"
    bag.write_bytes(data)
    (report,) = api.run([ROSInjectionConfig(bag, "drive", store=tmp_path / "store")]).recordings
    assert (report.status, report.exit_code) == (RunStatus.WITH_ERRORS, 4)
    assert report.unreadable_ranges
    topics = [topic for topic in report.topics if topic.promised is not None]
    assert sum(topic.unreadable for topic in topics) > 0
    for topic in topics:
        assert topic.promised == topic.read + topic.unreadable
        assert topic.read == topic.written + topic.filtered + topic.downsampled + topic.rejected


def test_run_of_truncated_recording_reports_unreadable_messages_in_status_counts_and_exit_code(
    tmp_path: Path,
) -> None:
    bag = tmp_path / "drive.mcap"
    bag.write_bytes(DRIVE.read_bytes()[: DRIVE.stat().st_size * 6 // 10])
    (report,) = api.run([ROSInjectionConfig(bag, "drive", store=tmp_path / "store")]).recordings
    assert (report.status, report.exit_code) == (RunStatus.WITH_ERRORS, 4)
    assert report.unreadable_ranges
    assert report.totals.unreadable is None or report.totals.unreadable > 0
    assert report.totals.rejected == 0


@pytest.fixture
def undefined(tmp_path: Path) -> Path:
    """A recording without definitions, where the type of one of two topics is in no distro."""
    number = define("std_msgs/msg/Int32", "int32 data\n")
    own = define("own_msgs/msg/Thing", "int32 a\n")
    bag = record(
        tmp_path / "old.db3",
        [
            message
            for at in range(3)
            for message in (("/known", number, at, {"data": at}), ("/own", own, at, {"a": at}))
        ],
    )
    with closing(sqlite3.connect(bag)) as db:
        db.execute("DELETE FROM message_definitions")
        db.commit()
    return bag


def test_run_with_undefined_type_counts_its_messages_as_unreadable(undefined: Path) -> None:
    config = ROSInjectionConfig(undefined, "old", ros_distro="ros2_humble", store=undefined.parent / "store")
    (report,) = api.run([config]).recordings
    assert (report.status, report.exit_code) == (RunStatus.WITH_ERRORS, 4)
    assert [(topic.topic, topic.promised, topic.read, topic.unreadable) for topic in report.topics] == [
        ("/known", 3, 3, 0),
        ("/own", 3, 0, 3),
    ]
    assert [
        (unreadable_range.topic, unreadable_range.count, unreadable_range.reason)
        for unreadable_range in report.unreadable_ranges
    ] == [("/own", 3, "no definition of own_msgs/msg/Thing can be used")]
    (chosen,) = api.run([replace(config, sequence_name="chosen", topics=("!/own",))]).recordings
    assert chosen.exit_code == 0


def test_run_with_undefined_type_and_raise_policy_fails(undefined: Path) -> None:
    config = ROSInjectionConfig(
        undefined,
        "old",
        store=undefined.parent / "store",
        manifest={"on_error": {"message": LoaderErrorPolicy.RAISE}},
    )
    with pytest.raises(BagError, match=r"/own: the definition of own_msgs/msg/Thing is not known"):
        api.RosbagInjector(config).run()
    api.RosbagInjector(replace(config, topics=("/known",))).run()


def test_run_with_rows_missing_in_destination_fails_verification(
    write_bag: WriteBag, write_job: WriteJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_bag({"/speed": [number(1), number(2)]})
    (job,) = api.compile_job(write_job())
    monkeypatch.setattr(
        "mosaico_ingest.destinations.store.session.StoreSession.stored",
        lambda _self: (StoredTopic("/speed", 1, 0, 0, 8),),
    )
    outcome = run_recording(Task(job))
    report = outcome.report
    assert isinstance(outcome.error, VerificationError)
    assert report.exit_code == 5
    assert "wrote 2 rows" in str(report.error)
    assert "found 1 rows" in str(report.error)


@pytest.mark.parametrize(
    ("damage", "said"), [("flip", "CRC"), ("cut", ""), ("remove", '"the file does not exist"')]
)
def test_verify_detects_damaged_file(
    damage: str,
    said: str,
    *,
    write_bag: WriteBag,
    write_job: WriteJob,
    run_job: RunJob,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    write_bag({"/speed": [number(value) for value in range(500)]})
    run_job(write_job())
    store = Store.open(tmp_path / "store")
    arguments = ["verify", "drive", "--store", str(store.path), "--json"]
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 0
    (segment,) = store.paths("drive", "/speed")
    data = bytearray(segment.read_bytes())
    data[100] ^= 0xFF
    segment.unlink()
    if damage != "remove":
        segment.write_bytes(data if damage == "flip" else data[:-20])
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 5
    assert said in capsys.readouterr().out


@pytest.mark.parametrize("table", [{}, {"timestamp_ns": []}, {"timestamp_ns": ["a"], "data": [1.0]}, None])
def test_verify_detects_replaced_file(
    table: dict[str, list[object]] | None,
    write_bag: WriteBag,
    write_job: WriteJob,
    run_job: RunJob,
    tmp_path: Path,
) -> None:
    write_bag({"/speed": [number(1)]})
    run_job(write_job())
    store = Store.open(tmp_path / "store")
    (segment,) = store.paths("drive", "/speed")
    rows = pq.read_table(segment)
    pq.write_table(rows.slice(0, 0) if table is None else pa.table(table), segment)
    (checked,) = verify(store.sequence("drive"))
    assert checked.problem
    with pytest.raises(SystemExit) as ended:
        main(["verify", "--store", str(tmp_path / "store")])
    assert ended.value.code == 5


def test_verify_detects_changed_rows(
    write_bag: WriteBag,
    write_job: WriteJob,
    run_job: RunJob,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    write_bag({"/speed": [number(value) for value in range(500)]})
    (topic,) = run_job(write_job()).topics
    store = Store.open(tmp_path / "store")
    assert topic.checksum == store.topic("drive", "/speed").checksum is not None
    (segment,) = store.paths("drive", "/speed")
    rows = pq.read_table(segment)
    other = rows.set_column(1, rows.schema.field(1), pc.add(rows["data"], 1))
    pq.write_table(other, segment, use_compliant_nested_type=False)
    with store.catalog.write() as db:  # a file of the same size, as far as anyone can tell
        db.execute("UPDATE segments SET bytes = ?", (segment.stat().st_size,))
    with pytest.raises(SystemExit) as ended:
        main(["verify", "--store", str(store.path)])
    assert ended.value.code == 5
    output = capsys.readouterr().err
    assert f"drive/speed: {segment}: its rows have the checksum" in output
    assert f"the catalog has {topic.checksum}" in output


def test_checksums_of_same_recording_are_equal_in_every_store(tmp_path: Path) -> None:
    jobs = [ROSInjectionConfig(DRIVE, "drive", store=tmp_path / name) for name in ("one", "other")]
    one, other = ({t.target: t.checksum for t in report.topics} for report in api.run(jobs).recordings)
    assert one == other
    assert len(set(one.values())) == len(one), "each topic has its own"


def test_run_into_catalog_without_checksums_adds_the_column(
    write_bag: WriteBag, write_job: WriteJob, run_job: RunJob, tmp_path: Path
) -> None:
    write_bag({"/speed": [number(1)]})
    run_job(write_job())
    make_format_1(tmp_path / "store")
    with pytest.raises(SystemExit) as ended:
        main(["verify", "--store", str(tmp_path / "store")])
    assert ended.value.code == 0
    run_job(write_job(sequence={"name": "drive", "if_exists": "append"}))
    segments = Store.open(tmp_path / "store").topic("drive", "/speed").segments
    assert [segment.checksum is None for segment in segments] == [True, False]


def interrupt_commits(monkeypatch: pytest.MonkeyPatch, *, signals: int) -> None:
    commit = StoreDestination.commit

    def interrupted(destination: StoreDestination, sessions: Sequence[Session]) -> list[Exception | None]:
        for _ in range(signals):
            signal.raise_signal(signal.SIGINT)
        return commit(destination, sessions)

    monkeypatch.setattr(StoreDestination, "commit", interrupted)


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("signals", [1, 2])
@pytest.mark.parametrize("group", [1, 2])
def test_run_interrupted_during_commit_finishes_it_unless_interrupted_twice(
    signals: int, group: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupt_commits(monkeypatch, signals=signals)
    monkeypatch.setattr("mosaico_ingest.destinations.store.destination._MAX_COMMITS", group)
    monkeypatch.setattr("mosaico_ingest.executors._MAX_S", 60.0)
    configs = [ROSInjectionConfig(DRIVE, name, store=tmp_path / "store") for name in ("a", "b", "c")]
    reports = api.run(configs).recordings
    earlier = RunStatus.COMPLETED if signals == 1 else RunStatus.INTERRUPTED
    assert [report.status for report in reports] == [*[earlier] * (group - 1), RunStatus.INTERRUPTED]
    assert reports[-1].exit_code == 130
    sequences = Store.open(tmp_path / "store").sequences()
    assert sum(info.rows for info in sequences) == sum(report.totals.written for report in reports)
    for report in reports:
        assert report.totals.read == report.totals.written + report.totals.rejected
        assert (report.totals.rejected == 0) is (signals == 1)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.usefixtures("interruptible")
def test_run_with_ignored_interrupt_during_commit_completes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupt_commits(monkeypatch, signals=1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    (report,) = api.run([ROSInjectionConfig(DRIVE, "drive", store=tmp_path / "store")]).recordings
    assert report.status is RunStatus.COMPLETED


@pytest.mark.parametrize("handed_over", [0, 1, 7])
def test_counts_of_interrupted_run_add_up(
    handed_over: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put, calls = WriteBuffer.put, count()

    def interrupted(buffer: WriteBuffer, writer: TopicWriter, batch: pa.RecordBatch) -> None:
        if next(calls) == handed_over:
            raise KeyboardInterrupt
        put(buffer, writer, batch)

    monkeypatch.setattr(WriteBuffer, "put", interrupted)
    (report,) = api.run([ROSInjectionConfig(DRIVE, "drive", store=tmp_path / "store")]).recordings
    assert (report.status, report.exit_code) == (RunStatus.INTERRUPTED, 130)
    assert report.totals.read > 0
    for topic in report.topics:
        assert topic.read == topic.written + topic.rejected, topic.topic
