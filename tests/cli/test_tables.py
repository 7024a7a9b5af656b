"""Tables of reports, plans, inspections and sequences: no number is truncated, and all reasons are stated."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_recordings import define, record

from mosaico_ingest import api
from mosaico_ingest.cli import plan as plan_command
from mosaico_ingest.cli import report as report_command
from mosaico_ingest.cli import store as store_command
from mosaico_ingest.cli.report import rejection_lines
from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.display import rate_text
from mosaico_ingest.findings import Stage
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.ontology.registry import ontology_type
from mosaico_ingest.report.events import RunStatus, TopicStatus
from mosaico_ingest.report.recording import Rejection, Report, TopicReport
from mosaico_ingest.report.run import RunReport
from mosaico_ingest.services.draft import draft_manifest
from mosaico_ingest.services.inspection import estimate_rate_hz
from mosaico_ingest.view.texts import value_text

JOB = Path(__file__).resolve().parents[2] / "configs" / "quickstart.yaml"
DRIVE = JOB.parent / "quickstart" / "drive.mcap"


@pytest.fixture
def narrow(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Print to 60 columns."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mosaico_ingest.cli.console.FILE_WIDTH", 60)


def words(capsys: pytest.CaptureFixture[str]) -> set[str]:
    text = capsys.readouterr().out
    assert "…" not in text
    return set(text.split())


def run_quickstart(folder: Path) -> RunReport:
    (job,) = api.compile_job(JOB)  # whose store is in the checkout
    return api.run([job.replace(target=job.target.replace(store=str(folder / "store")))])


@pytest.mark.usefixtures("narrow")
def test_print_report_narrow_terminal_keeps_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report_command.print_report(run_quickstart(tmp_path))
    assert {"1,000", "308.2", "500", "rejected", "written"} <= words(capsys)


@pytest.mark.usefixtures("narrow")
def test_print_inspection_narrow_terminal_keeps_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    report_command.print_inspection(api.inspect_recording(DRIVE))
    assert {"1,000", "100.0", "messages:"} <= words(capsys)


@pytest.mark.usefixtures("narrow")
def test_print_plan_narrow_terminal_keeps_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    tables = plan_command.PlanTables(JOB.parent)
    for recording in api.plan_job(JOB).recordings:
        tables.add(recording)
    assert {"1,000", "messages:"} <= words(capsys)


def test_print_report_batch_limits_number_of_reasons(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_quickstart(tmp_path)
    (drive,) = run.recordings
    why = Rejection(
        stage=Stage.DECODE,
        rule="truncated",
        count=3,
        reason="4 bytes needed",
        first_log_time_ns=0,
        first_offset=0,
    )
    imu = drive.topics[0].model_copy(update={"rejections": (why,)})
    bad = drive.model_copy(update={"topics": (imu,)})
    report_command.print_report(run.model_copy(update={"recordings": (bad,) * 25}))
    output = capsys.readouterr().out
    assert output.count("quickstart_drive: /imu: 3 rejected [truncated]: 4 bytes needed\n") == 20
    assert "… and 5 more reasons; --report FILE writes all of them\n" in output


def test_print_report_part_of_recording_compares_stored_size_with_messages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "job.yaml").write_text(f"bag: {{path: {DRIVE}, time: {{end: +1s}}}}\n")
    report_command.print_report(api.run(api.compile_job(tmp_path / "job.yaml")))
    assert " of messages)" in capsys.readouterr().out
    (tmp_path / "job.yaml").write_text(f"bag: {{path: {DRIVE}}}\nsequence: {{name: all}}\n")
    report_command.print_report(api.run(api.compile_job(tmp_path / "job.yaml")))
    assert " % of 497.3 kB)" in capsys.readouterr().out


def test_print_sequences_incomplete_sequence_prints_its_note(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sink = StoreSink(Store.open(tmp_path))
    for name in ("whole", "torn"):
        with sink.open(name, {}) as session:
            session.topic("/t", ontology_type("String"), {})
            if name == "torn":
                session.note_error("the disk is full")
    store_command.print_sequences(Store.open(tmp_path).listing())
    assert capsys.readouterr().out.splitlines()[-1:] == ["torn: incomplete: the disk is full"]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "-"),
        (True, "true"),
        (0.5, "0.5"),
        (b"abc", "<3 bytes>"),
        ([1.0, 2.0], "[1.0, 2.0]"),
        (list(range(1000)), "[0, 1, 2, 3, 4, 5, …] (1,000 values)"),
        ({"x": 1, "y": None}, "{x: 1, y: -}"),
        ([{"name": "a", "size": 4}] * 9, "[{name: a, size: 4}, …] (9 values)"),
        ("a" * 30, "aaaaaaaaaaaaaaaaaaaa… (30 characters)"),
    ],
)
def test_value_text_long_value_states_omitted_count(value: object, text: str) -> None:
    assert value_text(value, 20) == text


def test_written_text_interrupted_run_states_messages_of_recording(tmp_path: Path) -> None:
    (drive,) = run_quickstart(tmp_path).recordings
    assert drive.written_text == f"{drive.totals.written:,} of {drive.totals.read:,} messages written"
    topics = tuple(topic.model_copy(update={"read": 1, "written": 1}) for topic in drive.topics)
    stopped = drive.model_copy(update={"status": RunStatus.INTERRUPTED, "topics": topics})
    promised = sum(topic.promised or 0 for topic in topics if topic.status is not TopicStatus.EXCLUDED)
    written = stopped.totals.written
    assert stopped.written_text == f"{written} messages written before the run stopped, of {promised:,}"


def test_rates_of_inspect_init_and_run_agree(tmp_path: Path) -> None:
    inspection = api.inspect_recording(DRIVE)
    inspected = {topic.topic: rate_text(topic.rate_hz) for topic in inspection.topics}
    (report,) = run_quickstart(tmp_path).recordings
    stored = {topic.topic: rate_text(topic.rate_hz) for topic in report.topics if topic.written}
    assert len(stored) > 5
    assert stored == {topic: rate for topic, rate in inspected.items() if topic in stored}
    manifest = draft_manifest(inspection, DRIVE, folder=tmp_path)
    assert all(f" at {rate}" in manifest for rate in inspected.values())


@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag"])
def test_rate_of_topic_in_part_of_recording_is_equal_in_inspect_and_run(tmp_path: Path, suffix: str) -> None:
    number = define("std_msgs/msg/Float64", "float64 data", version=1 if suffix == ".bag" else 2)
    start_ns = 1_700_000_000_000_000_000
    always = [("/always", number, start_ns + step * 100_000_000, {"data": 1.0}) for step in range(101)]
    briefly = [
        ("/briefly", number, start_ns + 10**9 + step * 20_000_000, {"data": 1.0}) for step in range(51)
    ]
    recording = record(tmp_path / f"part{suffix}", sorted(always + briefly, key=lambda message: message[2]))
    inspection = api.inspect_recording(recording)
    rates = {topic.topic: topic.rate_hz for topic in inspection.topics}
    assert rates == pytest.approx({"/always": 10.0, "/briefly": 50.0})
    report = api.run([ROSInjectionConfig(recording, "part", store=str(tmp_path / "store"))])
    assert {topic.topic: topic.rate_hz for topic in report.recordings[0].topics} == pytest.approx(rates)


@pytest.mark.parametrize(
    ("count", "seconds", "rate"), [(10, 9.99, 1.0), (1000, 9.99, 100.0), (2, 100, 0.01), (37, 10, 3.65)]
)
def test_estimate_rate_hz_returns_roundest_rate_that_fits(count: int, seconds: float, rate: float) -> None:
    assert estimate_rate_hz(count, round(seconds * 1e9)) == pytest.approx(rate, rel=0.02)


def test_rejections_of_many_topics_for_one_reason_are_one_line() -> None:
    rejection = Rejection(
        stage="write", rule="not-written", count=5, reason="discarded", first_log_time_ns=0, first_offset=0
    )
    topics = tuple(
        TopicReport(
            topic=f"/t{number}",
            target=f"/t{number}",
            msgtype="std_msgs/msg/String",
            adapter="",
            ontology="",
            why="",
            status="written",
            promised=5,
            read=5,
            rejected=5,
            rejections=(rejection,),
        )
        for number in range(4)
    )
    report = Report.model_construct(topics=topics)
    assert list(rejection_lines(report)) == ["4 topics: 20 rejected [not-written]: discarded"]
    few = Report.model_construct(topics=topics[:2])
    assert list(rejection_lines(few)) == ["/t0, /t1: 10 rejected [not-written]: discarded"]
