"""The report of a run as Markdown, for the page of a CI job or a pull request."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from mosaico_ingest.findings import Severity, one_line
from mosaico_ingest.report.collect import STEP_WORDS, longest_step, slowest, step_seconds
from mosaico_ingest.report.compare import Comparison
from mosaico_ingest.report.contract import ExpectationResult, Outcome
from mosaico_ingest.report.files import RunReport, replay_command
from mosaico_ingest.report.model import Report
from mosaico_ingest.report.units import bytes_text, count_text, counted, percent_text, seconds_text

MAX_SLOWEST = 3
MAX_ROWS = 100
"""Rows of a table or list, because CI services limit the size of a job's page."""


def markdown_summary(report: RunReport, comparison: Comparison | None = None) -> str:
    """Return headline, a row for each recording, errors and rejections, and changes; problems come first."""
    recordings = sorted(report.recordings, key=lambda recording: recording.exit_code == 0)
    lines = [f"## Ingestion: {report.headline}", ""]
    if recordings:
        lines += ["| sequence | status | read | written | rejected | stored | time |"]
        lines += ["|---|---|---:|---:|---:|---:|---:|", *map(_row, recordings[:MAX_ROWS])]
    if len(recordings) > MAX_ROWS:
        lines += ["", f"… and {len(recordings) - MAX_ROWS} more, see the report file."]
    lines += _time_lines(report)
    lines += _contract_lines(recordings)
    problems = list(_problems(recordings))
    if problems:
        lines += ["", "### Problems", "", *problems[:MAX_ROWS]]
    commands = {f"    {command}" for one in recordings if (command := replay_command(report, one))}
    if commands:
        lines += ["", "Rejected messages are in the quarantine. Fix the manifest, then run:", ""]
        lines += sorted(commands)
    if comparison is not None:
        lines += ["", "### Changes since the earlier run", "", *_change_lines(comparison)]
    return "\n".join(lines) + "\n"


def _change_lines(comparison: Comparison) -> Iterator[str]:
    yield f"{comparison.headline}."
    if comparison.changes:
        yield from ("", "| recording | topic | property | before | now |", "|---|---|---|---:|---:|")
    for change in comparison.changes[:MAX_ROWS]:
        cells = (change.recording, change.topic, change.aspect, change.before, change.after)
        yield f"| {' | '.join(map(_escape, cells))} |"


def _row(recording: Report) -> str:
    totals = recording.totals
    cells = (
        _escape(recording.sequence),
        recording.status.value,
        count_text(totals.read),
        count_text(totals.written),
        count_text(totals.rejected),
        bytes_text(totals.stored_bytes),
        seconds_text(recording.duration_s),
    )
    return f"| {' | '.join(cells)} |"


def _time_lines(report: RunReport) -> list[str]:
    """Return the share of each step, and the slowest recordings if there are several."""
    seconds = step_seconds(report.summary.steps)
    total = sum(seconds.values())
    if not total:
        return []
    shares = ", ".join(f"{STEP_WORDS[name]} {percent_text(spent / total)}" for name, spent in seconds.items())
    lines = ["", f"Time: {shares}."]
    if len(report.recordings) > 1:
        recordings = (
            f"{_escape(recording.sequence)} {seconds_text(recording.duration_s)} ({longest_step(recording.steps)})"
            for _, recording in slowest(report.recordings, MAX_SLOWEST)
        )
        lines += ["", f"Slowest: {'; '.join(recordings)}."]
    return lines


def _contract_lines(recordings: Sequence[Report]) -> list[str]:
    """Return the number of expectations that passed, and a row for each failed one; errors come first."""
    checked = [(one.sequence, one.contract) for one in recordings if one.contract is not None]
    results = [(sequence, result) for sequence, contract in checked for result in contract.results]
    if not results:
        return []
    failed = [pair for pair in results if not pair[1].passed]
    failed.sort(key=lambda pair: pair[1].severity is not Severity.ERROR)
    passed = sum(result.outcome is Outcome.PASSED for _, result in results)
    lines = [
        "",
        "### Contract",
        "",
        f"{count_text(passed)} of {counted(len(results), 'expectation')} passed.",
    ]
    if failed:
        lines += ["", "| sequence | severity | expectation | result | location |", "|---|---|---|---|---|"]
        lines += [_expectation_row(sequence, result) for sequence, result in failed[:MAX_ROWS]]
    if len(failed) > MAX_ROWS:
        lines += ["", f"… and {len(failed) - MAX_ROWS} more, see the report file."]
    return lines


def _expectation_row(sequence: str, result: ExpectationResult) -> str:
    location = "" if result.location is None else str(result.location.span)
    cells = (sequence, result.severity.value, result.expectation, result.line, location)
    return f"| {' | '.join(map(_escape, cells))} |"


def _problems(recordings: Sequence[Report]) -> Iterator[str]:
    for recording in recordings:
        name = _escape(recording.sequence)
        if recording.error:
            yield f"- **{name}**: {_escape(recording.error)}"
        for topic in recording.topics:
            for rejection in topic.rejections:
                text = f"{count_text(rejection.count)} rejected [{rejection.rule}]: {rejection.reason}"
                yield f"- {name} {_escape(topic.target)}: {_escape(text)}"
        for item in recording.unreadable_ranges:
            count = "messages" if item.count is None else count_text(item.count)
            text = f"{count} unreadable: {item.reason}"
            yield f"- {name} {_escape(item.topic or 'recording')}: {_escape(text)}"


def _escape(text: str) -> str:
    """Return text on one line that neither ends a table cell nor becomes markup."""
    for character in "\\|<>*`[]":
        text = text.replace(character, f"\\{character}")
    return one_line(" ".join(text.split()))
