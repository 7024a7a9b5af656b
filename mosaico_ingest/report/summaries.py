"""Summaries of a run: changes since an earlier run, Markdown for CI jobs, and gauges for Prometheus."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.display import bytes_text, count_text, counted, percent_text, seconds_text
from mosaico_ingest.findings import Severity, one_line
from mosaico_ingest.report.events import RunStatus, TopicStatus
from mosaico_ingest.report.parts import ContractResult, ExpectationResult, Outcome, Step
from mosaico_ingest.report.recording import (
    STEP_WORDS,
    Report,
    TopicReport,
    longest_step,
    slowest,
    step_seconds,
)
from mosaico_ingest.report.run import RunReport, replay_command

RATE_CHANGE = 0.05
"""Share by which the rate of a topic must change to be listed."""
SIZE_CHANGE = 0.10
"""Share by which the stored size per row must change to be listed."""
SPEED_CHANGE = 0.25
"""Share by which the messages per second of a run must change to be listed."""
MAX_CHANGES = 500
"""Maximum number of changes of a comparison."""
ALL = "all recordings"
MAX_SLOWEST = 3
MAX_ROWS = 100
"""Rows of a table or list, because CI services limit the size of a job's page."""
_PREFIX = "mosaico_ingest"


class Change(Struct, frozen=True):
    """One difference between two reports."""

    recording: str
    """The sequence, or `all recordings`."""
    topic: str
    """The topic in the sequence; empty for a change of the recording."""
    aspect: str
    """The changed property, such as `rate`."""
    before: str = ""
    after: str = ""
    ratio: float | None = None
    """The new value divided by the old one; None if the values are not numbers."""


class Comparison(Struct, frozen=True):
    """The differences between the report of a run and an earlier one."""

    changes: tuple[Change, ...]
    """At most `MAX_CHANGES`: recordings first, then topics, then numbers."""
    total: int
    """Number of all changes."""
    matched: int
    """Number of recordings that both reports have."""

    @property
    def headline(self) -> str:
        """The number of changes and of compared recordings, in one line."""
        compared = counted(self.matched, "recording") if self.matched else "the topics of all recordings"
        return f"{counted(self.total, 'change') if self.total else 'no changes'}, {compared} compared"


def compare_reports(after: RunReport, before: RunReport) -> Comparison:
    """Return the changes since an earlier report.

    Recordings are matched by the name of their sequence; two reports of one recording each are compared in any case.
    Recordings without a counterpart are compared together, topic by topic.
    """
    earlier = {one.sequence: one for one in before.recordings}
    later = {one.sequence: one for one in after.recordings}
    if len(earlier) == len(later) == 1:
        earlier = dict(zip(later, earlier.values(), strict=True))
    names = [name for name in later if name in earlier]
    changes: list[Change] = []
    for name in names:
        changes += _compare_group(name, [earlier[name]], [later[name]])
    new = [one for name, one in later.items() if name not in earlier]
    missing = [one for name, one in earlier.items() if name not in later]
    if names:
        changes += [Change(one.sequence, "", "recording", "", "new") for one in new]
        changes += [Change(one.sequence, "", "recording", "missing now", "") for one in missing]
    if new and missing:
        changes += _compare_group(ALL, missing, new)
    changes.sort(key=lambda change: (bool(change.topic), change.ratio is not None))
    return Comparison(tuple(changes[:MAX_CHANGES]), len(changes), len(names))


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
    lines += _contract_section(recordings)
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


def prometheus_text(report: RunReport) -> str:
    """Return the totals of a run as gauges; they have no label per sequence, which keeps their number small."""
    return "\n".join(_gauges(report)) + "\n"


class ContractCounts:
    """The numbers of contracts and expectations by outcome."""

    def __init__(self) -> None:
        self._outcomes: Counter[bool] = Counter()
        self._counts: Counter[tuple[Outcome, Severity]] = Counter()

    def add(self, contract: ContractResult) -> None:
        """Count the results of a contract."""
        self._outcomes[contract.passed] += 1
        self._counts.update((result.outcome, result.severity) for result in contract.results)

    def gauges(self) -> str:
        """Return the numbers as gauges for Prometheus; empty without a contract."""
        return "".join(f"{line}\n" for line in self._lines())

    def _lines(self) -> Iterator[str]:
        if not self._outcomes:
            return
        yield from _gauge("contracts", "Recordings of the last run by the outcome of their data contracts.")
        for outcome, passed in ((Outcome.PASSED, True), (Outcome.FAILED, False)):
            yield f'{_PREFIX}_contracts{{outcome="{outcome.value}"}} {self._outcomes[passed]}'
        yield from _gauge("expectations", "Expectations of the last run by outcome and severity.")
        for outcome in Outcome:
            for severity in (Severity.ERROR, Severity.WARNING):
                labels = f'outcome="{outcome.value}",severity="{severity.value}"'
                yield f"{_PREFIX}_expectations{{{labels}}} {self._counts[outcome, severity]}"


class _Sum(Struct):
    """The topics of one name in several recordings."""

    rows: int = 0
    intervals: int = 0
    span_ns: int = 0
    stored_bytes: int = 0
    rejected: int = 0
    ontology: str = ""


def _compare_group(name: str, before: Sequence[Report], after: Sequence[Report]) -> Iterator[Change]:
    if len(before) == len(after) == 1:
        old, new = before[0].status, after[0].status
        if old is not new:
            yield Change(name, "", "status", _words(old), _words(new))
    if any(one.status is RunStatus.SKIPPED for one in (*before, *after)):
        return  # its topics were not read
    speed = Change(name, "", "messages per second")
    yield from _number(speed, _speed(before), _speed(after), SPEED_CHANGE, lambda value: f"{value:,.0f}")
    old_topics, new_topics = _sums(before), _sums(after)
    for topic in sorted(old_topics.keys() | new_topics.keys()):
        old_topic, new_topic = old_topics.get(topic), new_topics.get(topic)
        if old_topic is None:
            yield Change(name, topic, "topic", "", "new")
        elif new_topic is None:
            yield Change(name, topic, "topic", "missing now", "")
        else:
            yield from _compare_topic(name, topic, old_topic, new_topic)


def _compare_topic(name: str, topic: str, old: _Sum, new: _Sum) -> Iterator[Change]:
    if old.ontology != new.ontology:
        yield Change(name, topic, "ontology", old.ontology, new.ontology)
    if bool(old.rejected) != bool(new.rejected):
        yield Change(name, topic, "rejected", count_text(old.rejected), count_text(new.rejected))
    rate, size = Change(name, topic, "rate"), Change(name, topic, "stored size per row")
    yield from _number(rate, _rate(old), _rate(new), RATE_CHANGE, lambda value: f"{value:.4g} Hz")
    yield from _number(size, _size(old), _size(new), SIZE_CHANGE, bytes_text)


def _number(
    change: Change, old: float | None, new: float | None, least: float, text: Callable[[float], str]
) -> Iterator[Change]:
    """Yield the change with its values if they differ by a larger share than `least`."""
    if old and new and abs(new / old - 1) > least:
        yield replace(change, before=text(old), after=text(new), ratio=new / old)


def _sums(reports: Sequence[Report]) -> dict[str, _Sum]:
    sums: dict[str, _Sum] = {}
    for report in reports:
        for topic in report.topics:
            if topic.status is not TopicStatus.EXCLUDED:
                _add(sums.setdefault(topic.target, _Sum()), topic)
    return sums


def _add(total: _Sum, topic: TopicReport) -> None:
    total.rows += topic.rows
    total.stored_bytes += topic.stored_bytes
    total.rejected += topic.rejected
    total.ontology = topic.ontology
    if topic.start_ns is not None and topic.end_ns is not None and topic.end_ns > topic.start_ns:
        total.intervals += topic.rows - 1
        total.span_ns += topic.end_ns - topic.start_ns


def _rate(total: _Sum) -> float | None:
    return total.intervals / (total.span_ns / 1e9) if total.span_ns else None


def _size(total: _Sum) -> float | None:
    return total.stored_bytes / total.rows if total.rows else None


def _speed(reports: Sequence[Report]) -> float | None:
    seconds = sum(one.duration_s for one in reports)
    return sum(one.totals.read for one in reports) / seconds if seconds else None


def _words(status: RunStatus) -> str:
    return status.value.replace("_", " ")


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


def _contract_section(recordings: Sequence[Report]) -> list[str]:
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


def _gauges(report: RunReport) -> Iterator[str]:
    summary = report.summary
    yield from _gauge("recordings", "Recordings of the last run by status.")
    for status in RunStatus:
        yield f'{_PREFIX}_recordings{{status="{status.value}"}} {summary.statuses.get(status, 0)}'
    yield from _gauge("messages", "Messages of the last run by outcome.")
    for fate in ("read", "written", "filtered", "downsampled", "rejected", "unreadable"):
        yield f'{_PREFIX}_messages{{fate="{fate}"}} {getattr(summary, fate)}'
    contracts = ContractCounts()
    for one in report.recordings:
        if one.contract is not None:
            contracts.add(one.contract)
    yield from contracts.gauges().splitlines()
    yield from _gauge(
        "step_seconds", "Time of the last run by step; the write step runs in parallel to the others."
    )
    for step in Step:
        yield f'{_PREFIX}_step_seconds{{step="{step.value}"}} {getattr(summary.steps, step.value):.6g}'
    ended = 0.0 if summary.ended_at is None else summary.ended_at.timestamp()
    single: tuple[tuple[str, str, float], ...] = (
        ("source_bytes", "Size of the recordings.", summary.source_bytes),
        ("stored_bytes", "Size of the stored rows.", summary.stored_bytes),
        ("working_seconds", "Time spent on recordings.", summary.duration_s),
        ("last_end_timestamp_seconds", "When the last recording ended, since the epoch.", ended),
        ("exit_code", "The exit code of the run.", summary.exit_code),
    )
    for name, what, value in single:
        yield from _gauge(name, what)
        yield f"{_PREFIX}_{name} {value:.15g}"


def _gauge(name: str, what: str) -> Iterator[str]:
    yield f"# HELP {_PREFIX}_{name} {what}"
    yield f"# TYPE {_PREFIX}_{name} gauge"
