"""Results of `run`, `plan` and `check` as JUnit XML and SARIF, the formats that CI services show."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from msgspec import Struct

from mosaico_ingest.cli.options import write_output
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.lint.formats import Case, Suite, junit_text, sarif_text
from mosaico_ingest.pipeline.plan_document import RecordingPlan
from mosaico_ingest.report.contract import ContractResult, ExpectationResult, Outcome
from mosaico_ingest.report.files import RunReport


class CheckedRecording(Struct, frozen=True):
    """The outcome of one recording: the results of its contract, and the error that ended its run."""

    name: str
    """The name of the sequence or of the check."""
    contract: ContractResult | None = None
    error: str | None = None
    findings: tuple[Finding, ...] = ()
    """The findings of the error."""


def write_ci_files(recordings: Sequence[CheckedRecording], *, junit: Path | None, sarif: Path | None) -> None:
    """Write the files of `--junit` and `--sarif`.

    Raises:
        SinkError: A file cannot be written.
    """
    if junit is not None:
        write_output(junit, junit_text(map(_suite, recordings)))
    if sarif is not None:
        findings = dict.fromkeys(finding for one in recordings for finding in _findings(one))
        write_output(sarif, sarif_text(tuple(findings)))


def _suite(recording: CheckedRecording) -> Suite:
    """Return a test case for each expectation and each other finding; a recording without both is one test case."""
    results = recording.contract.results if recording.contract is not None else ()
    cases = [_case(result, recording.name) for result in results]
    cases += [
        Case(f"{finding.rule}: {finding.message}", recording.name, failure=finding, span=finding.span)
        for finding in _other_findings(recording)
    ]
    return Suite(recording.name, tuple(cases) or (Case("ingest", recording.name),))


def _case(result: ExpectationResult, recording: str) -> Case:
    topic = f" {result.topic}" if result.topic and result.topic not in result.expectation else ""
    span = None if result.location is None else result.location.span
    failure = result.finding if result.outcome is Outcome.FAILED else None
    skipped = result.text if result.outcome is Outcome.SKIPPED else None
    return Case(f"{result.expectation}{topic}", recording, failure=failure, skipped=skipped, span=span)


def _findings(recording: CheckedRecording) -> Iterator[Finding]:
    results = recording.contract.results if recording.contract is not None else ()
    yield from (finding for result in results if (finding := result.finding) is not None)
    yield from _other_findings(recording)


def _other_findings(recording: CheckedRecording) -> Iterable[Finding]:
    """Return the findings of the error that are not results of the contract, or the error itself if it has none."""
    has_results = recording.contract is not None
    others = [one for one in recording.findings if not has_results or one.rule != "expectation-failed"]
    if others or recording.error is None or recording.findings:
        return others
    return [Finding("run-failed", Severity.ERROR, recording.error)]


def run_outcomes(report: RunReport) -> list[CheckedRecording]:
    """Return the outcome of each recording of a run."""
    return [
        CheckedRecording(
            recording.sequence,
            recording.contract,
            recording.error,
            tuple(each.finding for each in recording.error_findings),
        )
        for recording in report.recordings
    ]


def plan_outcomes(recordings: Sequence[RecordingPlan]) -> list[CheckedRecording]:
    """Return the outcome of each planned recording: what the index and the sample reveal about its contract."""
    return [
        CheckedRecording(recording.plan["sequence"]["name"], recording.contract) for recording in recordings
    ]
