"""The values of one recording on the page of a run."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.display import (
    bytes_text,
    count_text,
    counted,
    interval_text,
    rate_text,
    stored_text,
    time_text,
)
from mosaico_ingest.errors import IngestError
from mosaico_ingest.job.values import LoaderErrorPolicy
from mosaico_ingest.pages.design import Axis, Span, Track, draw_track, optional_span, time_axis
from mosaico_ingest.report.events import RunStatus, TopicStatus
from mosaico_ingest.report.parts import ExpectationResult, Outcome
from mosaico_ingest.report.recording import (
    STEP_WORDS,
    Report,
    TopicReport,
    folder_link,
    longest_step,
    step_seconds,
    unreadable_text,
)
from mosaico_ingest.report.run import RunReport, replay_command

FAILED = {RunStatus.FAILED, RunStatus.INTERRUPTED}
STATUS_WORDS = {
    RunStatus.COMPLETED: "completed",
    RunStatus.WITH_ERRORS: "some messages are missing",
    RunStatus.DIVERTED: "diverted, contract violated",
    RunStatus.SKIPPED: "already stored",
    RunStatus.FAILED: "failed",
    RunStatus.INTERRUPTED: "interrupted",
}
STATUS_COLORS = {
    RunStatus.COMPLETED: "good",
    RunStatus.WITH_ERRORS: "warn",
    RunStatus.DIVERTED: "bad",
    RunStatus.SKIPPED: "dim",
    RunStatus.FAILED: "bad",
    RunStatus.INTERRUPTED: "bad",
}
OUTCOMES = {"failed": 0, "warning": 1, "skipped": 2, "passed": 3}
"""The words for outcomes of expectations, in the order of lists."""
MAX_EXAMPLES = 3
"""Quarantined messages that the page shows for each topic and rule."""
MAX_INDEX_BYTES = 1 << 20
"""Bytes of a quarantine's index that are searched for examples."""
MAX_DECODED_BYTES = 16 << 20
"""Bytes of a quarantine file above which its messages are not decoded."""
VALUE_WIDTH = 300
"""Characters of the fields of a quarantined message."""
MAX_SEARCH_TOPICS = 200
"""Topics by whose names a recording can be found."""


class ContractRow(Struct, frozen=True):
    """The result of one expectation, and the recording."""

    recording_id: str
    sequence: str
    result: ExpectationResult

    @property
    def color(self) -> str:
        """The class of the outcome's color."""
        if self.result.outcome is Outcome.FAILED:
            return "bad" if self.result.severity.value == "error" else "warn"
        return "good" if self.result.outcome is Outcome.PASSED else "dim"

    @property
    def word(self) -> str:
        """The outcome in words."""
        if self.result.outcome is Outcome.FAILED:
            return "failed" if self.result.severity.value == "error" else "warning"
        return self.result.outcome.value

    @property
    def occurrence(self) -> str:
        """The time of the first violation."""
        first = self.result.first
        return time_text(first.log_time_ns) if first and first.log_time_ns is not None else ""


def contract_rows(recording_id: str, report: Report) -> list[ContractRow]:
    """Return the results of a recording: errors first, then warnings, skipped and passed expectations."""
    results = report.contract.results if report.contract else ()
    rows = [ContractRow(recording_id, report.sequence, result) for result in results]
    return sorted(rows, key=lambda row: OUTCOMES[row.word])


class ContractSummary(Struct, frozen=True):
    """The results of one expectation for all recordings."""

    row: ContractRow
    """The first of the gravest results."""
    counts: dict[str, int]
    """Number of recordings by outcome, the gravest first."""


class ContractSummaries:
    """The results of expectations, collected recording by recording."""

    def __init__(self) -> None:
        self._groups: dict[tuple[str, str | None], tuple[ContractRow, Counter[str]]] = {}

    def add(self, at: int, report: Report) -> None:
        """Add the results of a recording."""
        for row in contract_rows(f"r{at}", report):
            key = (row.result.expectation, row.result.topic)
            gravest, counts = self._groups.get(key, (row, Counter[str]()))
            counts[row.word] += 1
            self._groups[key] = (row if OUTCOMES[row.word] < OUTCOMES[gravest.word] else gravest, counts)

    def summaries(self) -> list[ContractSummary]:
        """Return the results by expectation and topic, those with the gravest outcome first."""
        summaries = [
            ContractSummary(row, {word: counts[word] for word in OUTCOMES if counts[word]})
            for row, counts in self._groups.values()
        ]
        return sorted(summaries, key=lambda summary: OUTCOMES[summary.row.word])


def problem_rank(report: Report) -> int:
    """Return 0 without problems, 1 with missing messages or warnings, 2 if failed or with a violated contract."""
    contract = report.contract
    if report.status in FAILED or (contract is not None and contract.errors):
        return 2
    is_incomplete = (
        report.status is RunStatus.WITH_ERRORS or report.totals.rejected or report.unreadable_ranges
    )
    return int(bool(is_incomplete or (contract is not None and contract.warnings)))


class StepShare(Struct, frozen=True):
    """One step of a run, and its part of a bar from 0 to 1."""

    name: str
    label: str
    seconds: float
    share: float
    start: float


def step_shares(seconds: Mapping[str, float], *, stacked: bool = True) -> list[StepShare]:
    """Return the steps; `stacked` steps start where the previous one ends. Without any time, there are none."""
    total = sum(seconds.values())
    steps: list[StepShare] = []
    start = 0.0
    for name, spent in seconds.items() if total else ():
        steps.append(StepShare(name, STEP_WORDS[name], spent, spent / total, start if stacked else 0.0))
        start += spent / total
    return steps


class RecordingView:
    """The values of one recording on the page; those of its content are computed when they are rendered."""

    def __init__(self, at: int, run: RunReport, folder: Path | None) -> None:
        report = run.recordings[at]
        self.report = report
        self.id = f"r{at}"
        self.status = STATUS_WORDS[report.status]
        self.color = STATUS_COLORS[report.status]
        contract = report.contract
        self.violations = len(contract.errors) if contract else 0
        self.warnings = len(contract.warnings) if contract else 0
        self.totals = report.totals
        self.rank = problem_rank(report)
        self.written = report.written_text
        self.unreadable = unreadable_text(report)
        self._run, self._folder = run, folder

    @property
    def search_words(self) -> str:
        """The words by which the list can be filtered."""
        topics = [topic.target for topic in self.report.topics[:MAX_SEARCH_TOPICS]]
        return " ".join((self.report.sequence, self.status, *self.report.files, *topics))

    @property
    def size(self) -> str:
        """The size of the files, and the stored size."""
        source, stored_bytes = self.report.source_bytes, self.totals.stored_bytes
        return stored_text(source, stored_bytes) if stored_bytes else bytes_text(source)

    @property
    def messages_per_s(self) -> int:
        """Messages read per second."""
        return round(self.totals.read / self.report.duration_s) if self.report.duration_s else 0

    @property
    def steps(self) -> list[StepShare]:
        """The steps of the run."""
        return step_shares(step_seconds(self.report.steps))

    @property
    def longest_step(self) -> str:
        """The longest step and its share."""
        return longest_step(self.report.steps)

    @property
    def quarantined(self) -> int:
        """Number of messages in the quarantine."""
        return sum(topic.quarantined for topic in self.report.topics)

    @property
    def quarantine_link(self) -> str | None:
        """The link to the folder of the quarantine."""
        return None if self._folder is None else folder_link(self.report, self._folder)

    @property
    def replay_command(self) -> str | None:
        """The command that adds the quarantined messages."""
        return replay_command(self._run, self.report)

    @cached_property
    def axis(self) -> Axis | None:
        """The time axis of all topics."""
        return time_axis(_times(self.report))

    @cached_property
    def topics(self) -> list[TopicView]:
        """The selected topics by name."""
        selected = [topic for topic in self.report.topics if topic.status is not TopicStatus.EXCLUDED]
        unknown = _spans(self.report, None)
        return [
            TopicView(topic, self.axis, (*_spans(self.report, topic.target), *unknown))
            for topic in sorted(selected, key=lambda topic: topic.target)
        ]

    @property
    def has_marks(self) -> bool:
        """Whether a track shows rejected or unreadable messages."""
        return any(topic.track and (topic.track.rejected or topic.track.unreadable) for topic in self.topics)

    @property
    def excluded(self) -> dict[str, list[str]]:
        """The excluded topics by reason."""
        reasons: dict[str, list[str]] = {}
        for topic in self.report.topics:
            if topic.status is TopicStatus.EXCLUDED:
                reasons.setdefault(topic.why, []).append(f"{topic.topic} ({topic.msgtype})")
        return dict(sorted(reasons.items()))

    @property
    def rejections(self) -> list[str]:
        """The reasons of rejections."""
        return [
            f"{topic.target}: {counted(rejection.count, 'message')} at {rejection.stage.value} "
            f"[{rejection.rule}]: {rejection.reason} (first log time "
            f"{time_text(rejection.first_log_time_ns)}, offset {count_text(rejection.first_offset)})"
            for topic in self.report.topics
            for rejection in topic.rejections
        ]

    @property
    def unreadable_ranges(self) -> list[str]:
        """The unreadable ranges."""
        return [
            f"{item.topic or 'the recording'}: "
            f"{'unknown number of messages' if item.count is None else counted(item.count, 'message')}"
            f"{'' if item.offset is None else f' at offset {count_text(item.offset)}'}: {item.reason}"
            for item in self.report.unreadable_ranges
        ]

    @property
    def contract_rows(self) -> list[ContractRow]:
        """The results of the contract."""
        return contract_rows(self.id, self.report)

    @cached_property
    def examples(self) -> list[QuarantinedMessage]:
        """The first quarantined messages of each topic and rule, if the quarantine can be read."""
        return _examples(self.report) if self.quarantined else []


class TopicView:
    """The values of one topic on the page."""

    def __init__(self, report: TopicReport, axis: Axis | None, unreadable: Sequence[Span]) -> None:
        self.report = report
        timeline = report.timeline
        self.rate = rate_text(report.rate_hz)
        self.jitter = interval_text(timeline.jitter_ns) if timeline else ""
        self.gap_count = timeline.gap_count if timeline else 0
        self.track: Track | None = None
        if axis is not None:
            rejected = [
                (stretch.start_ns, stretch.end_ns)
                for rejection in report.rejections
                for stretch in rejection.stretches
            ]
            self.track = draw_track(
                axis,
                report.target,
                timeline,
                span=optional_span(report.start_ns, report.end_ns),
                rejected=rejected,
                unreadable=unreadable,
            )


class QuarantinedMessage(Struct, frozen=True):
    """A message in the quarantine."""

    source: str
    """The topic in the recording."""

    topic: str
    rule: str
    log_time_ns: int
    offset: int
    size: int
    reason: str
    values: str = ""
    """The decoded fields; empty if the message cannot be decoded."""


def _examples(report: Report) -> list[QuarantinedMessage]:
    """Return the first messages of each topic and rule, with their values as far as they can be decoded."""
    messages = list(_indexed_messages(report))
    if not messages or report.quarantine is None:
        return messages
    values = _decoded_values(Path(report.quarantine), {(each.source, each.log_time_ns) for each in messages})
    return [replace(each, values=values.get((each.source, each.log_time_ns), "")) for each in messages]


def _decoded_values(quarantine: Path, selected: set[tuple[str, int]]) -> dict[tuple[str, int], str]:
    """Return the fields of messages by topic and log time; empty for a file that is too large or cannot be read."""
    from mosaico_ingest.rosbag.loader import ROSLoader  # noqa: PLC0415 - only pages with quarantined messages need Arrow
    from mosaico_ingest.view.texts import value_text  # noqa: PLC0415 - only pages with quarantined messages need Arrow

    values: dict[tuple[str, int], str] = {}
    try:
        if quarantine.stat().st_size > MAX_DECODED_BYTES:
            return {}
        with ROSLoader(quarantine, error_policy=LoaderErrorPolicy.IGNORE) as messages:
            for message, error in messages:
                key = (message.topic, message.timestamp_ns)
                if error is None and key in selected:
                    values.setdefault(key, value_text(message.data, VALUE_WIDTH))
                    if len(values) == len(selected):
                        break
    except (IngestError, OSError):
        return values
    return values


def _indexed_messages(report: Report) -> Iterator[QuarantinedMessage]:
    """Yield the first messages of each topic and rule in the start of the quarantine's index."""
    if report.quarantine is None:
        return
    counts: dict[tuple[str, str], int] = {}
    try:
        with Path(report.quarantine).with_suffix(".jsonl").open("rb") as file:
            lines = file.read(MAX_INDEX_BYTES).splitlines()
    except (OSError, ValueError):
        return
    for line in lines:
        try:
            entry: dict[str, Any] = json.loads(line)
            message = QuarantinedMessage(
                str(entry["topic"]),
                str(entry["target"]),
                str(entry["rule"]),
                int(entry["log_time_ns"]),
                int(entry["offset"]),
                int(entry["bytes"]),
                str(entry["reason"]),
            )
        except (ValueError, KeyError, TypeError):
            continue  # the last line can be incomplete
        key = (message.topic, message.rule)
        counts[key] = counts.get(key, 0) + 1
        if counts[key] <= MAX_EXAMPLES:
            yield message


def _times(report: Report) -> Iterator[int]:
    """Yield the times between which a recording's axis extends."""
    for topic in report.topics:
        if topic.status is not TopicStatus.EXCLUDED:
            yield from (time for time in (topic.start_ns, topic.end_ns) if time is not None)
            for rejection in topic.rejections:
                yield from (time for each in rejection.stretches for time in (each.start_ns, each.end_ns))
    for item in report.unreadable_ranges:
        yield from (time for time in (item.start_ns, item.end_ns) if time is not None)


def _spans(report: Report, topic: str | None) -> list[Span]:
    """Return the times of the unreadable ranges of a topic; None selects the ranges that affect unknown topics."""
    return [
        (item.start_ns, item.end_ns)
        for item in report.unreadable_ranges
        if item.topic == topic and item.start_ns is not None and item.end_ns is not None
    ]
