"""The report is the sum of the events, and round-trips through its file."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.cli.options import write_output
from mosaico_ingest.errors import SinkError
from mosaico_ingest.findings import Finding, Severity, Stage
from mosaico_ingest.report.events import (
    Expected,
    Noted,
    Rejected,
    RunFinished,
    RunStarted,
    RunStatus,
    TopicClosed,
    TopicProgress,
    TopicStatus,
    Unreadable,
)
from mosaico_ingest.report.recording import MAX_STRETCHES, Collector, Report
from mosaico_ingest.report.run import RunReport

IMU = Expected("/imu", "/sensors/imu", "sensor_msgs/msg/Imu", "IMUAdapter", "IMU", "built-in", 10)
LEFT = Expected("/debug", "/debug", "std_msgs/msg/String", "", "", "left out", None, excluded=True)


def started() -> Collector:
    collector = Collector()
    collector(RunStarted("drive", "./mosaico", ("drive.mcap",), 1000, (IMU, LEFT)))
    return collector


def rejected(rule: str, count: int) -> Rejected:
    return Rejected(IMU.target, Stage.ADAPT, rule, count, f"{rule} at first", 7, 70)


@given(
    st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9), st.sampled_from(["nan", "range"])), max_size=20)
)
def test_collector_sums_every_increment(steps: list[tuple[int, int, str]]) -> None:
    collector = started()
    for written, lost, rule in steps:
        collector(
            TopicProgress(
                IMU.target, read=written + lost, written=written, rows=written, payload_bytes=written
            )
        )
        if lost:
            collector(rejected(rule, lost))
    topic = collector.report().topics[0]
    assert topic.written == sum(written for written, _, _ in steps)
    assert topic.rejected == sum(lost for _, lost, _ in steps) == collector.rejected
    assert topic.read == topic.written + topic.rejected
    assert len(topic.rejections) <= 2


@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 100)), min_size=1, max_size=400))
def test_collector_stretches_cover_all_rejected_times_and_are_limited(spans: list[tuple[int, int]]) -> None:
    collector = started()
    for start, length in spans:
        event = Rejected(IMU.target, Stage.ADAPT, "nan", 1, "nan", start, 7, last_log_time_ns=start + length)
        collector(event)
    (rejection,) = collector.report().topics[0].rejections
    covered = [(each.start_ns, each.end_ns) for each in rejection.stretches]
    assert len(covered) <= MAX_STRETCHES
    assert covered == sorted(covered)
    assert min(start for start, _ in spans) == covered[0][0]
    assert max(start + length for start, length in spans) == max(end for _, end in covered)
    if len(spans) <= MAX_STRETCHES:
        assert covered == sorted((start, start + length) for start, length in spans)
    for start, length in spans:
        assert any(low <= start and start + length <= high for low, high in covered)


def test_collector_rejection_without_last_time_has_no_stretch() -> None:
    collector = started()
    collector(rejected("nan", 1))
    assert collector.report().topics[0].rejections[0].stretches == ()


def test_collector_rejection_keeps_first_reason() -> None:
    collector = started()
    collector(rejected("nan", 2))
    collector(Rejected(IMU.target, Stage.ADAPT, "nan", 3, "another text", 9, 90))
    rejection = collector.report().topics[0].rejections[0]
    assert (rejection.count, rejection.reason, rejection.first_offset) == (5, "nan at first", 70)


def test_collector_excluded_topic_is_not_in_totals() -> None:
    report = started().report()
    assert [topic.status for topic in report.topics] == [TopicStatus.EMPTY, TopicStatus.EXCLUDED]
    assert report.totals.read == 0


def test_report_computes_rate_and_compression() -> None:
    collector = started()
    collector(TopicProgress(IMU.target, read=11, written=11, rows=11, start_ns=0, end_ns=1_000_000_000))
    collector(TopicClosed(IMU.target, TopicStatus.WRITTEN, stored_bytes=250))
    report = collector.report()
    assert report.topics[0].rate_hz == 10.0
    assert report.compression == 0.25


def test_collector_discarded_rows_have_no_time_range() -> None:
    collector = started()
    collector(TopicProgress(IMU.target, read=1, written=1, rows=1, start_ns=5, end_ns=5))
    collector(TopicProgress(IMU.target, written=-1, rows=-1))
    topic = collector.report().topics[0]
    assert (topic.written, topic.start_ns, topic.end_ns) == (0, None, None)


def test_collector_keeps_findings_and_unreadable_ranges() -> None:
    collector = started()
    collector(Noted(Finding("mixed-types", Severity.WARNING, "two types")))
    collector(Unreadable(None, 3, 100, "a broken chunk"))
    report = collector.report()
    assert "two types" in report.findings[0]
    assert report.unreadable_ranges[0].count == 3
    assert collector.unreadable


def recording(status: RunStatus, code: int) -> Report:
    collector = started()
    collector(RunFinished(status, code))
    return collector.report()


@pytest.mark.parametrize(
    ("codes", "expected"),
    [
        ([], 0),
        ([0, 0], 0),
        ([0, 4], 4),
        ([4, 3], 3),
        ([3, 2], 2),
        ([4, 3, 1], 1),
        ([1, 5], 5),
        ([3, 130], 130),
    ],
)
def test_run_report_exit_code_is_most_severe(codes: list[int], expected: int) -> None:
    reports = tuple(recording(RunStatus.COMPLETED, code) for code in codes)
    assert RunReport(tool="t", recordings=reports).exit_code == expected


def test_write_output_report_round_trips(tmp_path: Path) -> None:
    report = RunReport(tool="t", recordings=(recording(RunStatus.COMPLETED, 0),))
    write_output(tmp_path / "deep" / "report.json", report.model_dump_json())
    assert RunReport.model_validate_json((tmp_path / "deep" / "report.json").read_text()) == report
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["report.json"]


def test_write_output_unwritable_file_raises(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SinkError, match="report"):
        write_output(tmp_path / "file" / "report.json", "{}")
