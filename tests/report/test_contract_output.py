"""Results of contracts in the Markdown summary and the Prometheus metrics."""

from __future__ import annotations

from datetime import datetime, timezone

from mosaico_ingest.findings import Severity
from mosaico_ingest.report.events import RunStatus
from mosaico_ingest.report.parts import ContractResult, ExpectationResult, Location, Outcome
from mosaico_ingest.report.recording import Report
from mosaico_ingest.report.run import RunReport
from mosaico_ingest.report.summaries import ContractCounts, markdown_summary, prometheus_text

LOCATION = Location(file="job.yaml", line=7, column=5, end_line=7, end_column=9)


def report(*outcomes: tuple[Outcome, Severity]) -> RunReport:
    results = tuple(
        ExpectationResult(
            expectation=f"expect.topics./imu.gap_{number}",
            severity=severity,
            outcome=outcome,
            text="the longest gap is 2 s | at most 50 ms",
            topic="/imu",
            location=LOCATION,
        )
        for number, (outcome, severity) in enumerate(outcomes)
    )
    recording = Report(
        sequence="drive",
        destination="store",
        files=(),
        status=RunStatus.FAILED,
        exit_code=6,
        started_at=datetime(2026, 1, 1, tzinfo=timezone.utc),
        duration_s=1,
        source_bytes=1,
        contract=ContractResult(on_failure="fail", results=results) if results else None,
    )
    return RunReport(tool="t", recordings=(recording,))


MIXED = report(
    (Outcome.PASSED, Severity.ERROR),
    (Outcome.FAILED, Severity.WARNING),
    (Outcome.FAILED, Severity.ERROR),
    (Outcome.SKIPPED, Severity.ERROR),
)


def test_markdown_lists_failed_expectations_errors_first() -> None:
    text = markdown_summary(MIXED)
    assert "1 of 4 expectations passed." in text
    rows = [line.split(" | ")[1:3] for line in text.splitlines() if line.startswith("| drive | ")]
    assert [row for row in rows if row[0] in {"error", "warning"}] == [
        ["error", "expect.topics./imu.gap_2"],
        ["warning", "expect.topics./imu.gap_1"],
    ]
    assert "/imu: the longest gap is 2 s \\| at most 50 ms | job.yaml:7:5 |" in text


def test_markdown_without_contract_has_no_section() -> None:
    assert "### Contract" not in markdown_summary(report())


def test_metrics_count_expectations_by_outcome_and_severity() -> None:
    lines = prometheus_text(MIXED).splitlines()
    assert [line for line in lines if line.startswith("mosaico_ingest_expectations")] == [
        'mosaico_ingest_expectations{outcome="passed",severity="error"} 1',
        'mosaico_ingest_expectations{outcome="passed",severity="warning"} 0',
        'mosaico_ingest_expectations{outcome="failed",severity="error"} 1',
        'mosaico_ingest_expectations{outcome="failed",severity="warning"} 1',
        'mosaico_ingest_expectations{outcome="skipped",severity="error"} 1',
        'mosaico_ingest_expectations{outcome="skipped",severity="warning"} 0',
    ]


def test_metrics_count_contracts_by_outcome() -> None:
    lines = prometheus_text(MIXED).splitlines()
    assert 'mosaico_ingest_contracts{outcome="passed"} 0' in lines
    assert 'mosaico_ingest_contracts{outcome="failed"} 1' in lines
    assert ContractCounts().gauges() == ""


def test_metrics_without_contract_have_no_expectations() -> None:
    assert "expectations" not in prometheus_text(report())
