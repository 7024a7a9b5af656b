"""The report of a run as one HTML page without external resources."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from msgspec import Struct

from mosaico_ingest.findings import one_line
from mosaico_ingest.report import units
from mosaico_ingest.report.collect import (
    STEP_WORDS,
    longest_step,
    slowest,
    step_seconds,
    total_seconds,
)
from mosaico_ingest.report.events import RunStatus, TopicStatus
from mosaico_ingest.report.model import Report, RunReport, TopicReport, folder_link, replay_command
from mosaico_ingest.report.timing import Gap, TimelineReport
from mosaico_ingest.report.units import (
    bytes_text,
    count_text,
    counted,
    seconds_text,
    stored_text,
    time_text,
    unreadable_text,
    written_text,
)

__all__ = [
    "STATUS_WORDS",
    "draw_topic",
    "html_page",
]

STATUS_WORDS = {
    RunStatus.COMPLETED: "completed",
    RunStatus.WITH_ERRORS: "completed, some messages are missing",
    RunStatus.SKIPPED: "skipped, already stored",
    RunStatus.FAILED: "failed",
    RunStatus.INTERRUPTED: "interrupted",
}
FAILED = {RunStatus.FAILED, RunStatus.INTERRUPTED}
MAX_OPEN = 20
"""Recordings with problems that are expanded when the page opens."""
MAX_SLOWEST = 10
WIDTH, HEIGHT = 240, 24
"""Size of the drawing of a topic's rows, in its own units."""
MIN_BAR = 2.0
"""Width of the narrowest bar, so that a single row is visible."""
GAP_HEIGHT = 3
INTERVALS_PER_BAR = 4
"""Least number of median intervals per bar: shorter bars of a regular topic would look irregular."""


def html_page(report: RunReport, folder: Path | None = None) -> str:
    """Return the page; links to files are relative to `folder` (default: the current one), the page's folder."""
    folder = folder or Path()
    recordings = [_Recording(at, report, folder) for at in range(len(report.recordings))]
    for recording in [one for one in recordings if one.has_problem][:MAX_OPEN]:
        recording.is_open = True
    if len(recordings) == 1:
        recordings[0].is_open = True
    seconds = total_seconds(report.recordings)
    started = min((one.started_at for one in report.recordings), default=None)
    several = len(recordings) > 1
    return (
        _environment()
        .get_template("page.html")
        .render(
            report=report,
            headline=_headline(report),
            started_at=f"{started:%Y-%m-%d %H:%M:%S}" if started else None,
            totals=_totals(report),
            failed=[one for one in recordings if one.report.status in FAILED],
            rejections=_rejection_groups(recordings),
            steps=_steps(seconds, stacked=False),
            writer_s=sum(one.steps.write for one in report.recordings),
            slowest=[recordings[at] for at, _ in slowest(report.recordings, MAX_SLOWEST)] if several else [],
            recordings=recordings,
        )
    )


@cache
def _environment() -> Environment:
    """Return the templates with autoescaping. Control characters of values are replaced by escapes."""

    def finalize(value: object) -> object:
        if isinstance(value, Markup) or not isinstance(value, str):
            return value
        return "\n".join(map(one_line, value.split("\n")))

    environment = Environment(
        loader=PackageLoader("mosaico_ingest.report"),
        autoescape=True,
        finalize=finalize,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    names = ("bytes_text", "count_text", "percent_text", "rate_text", "seconds_text")
    environment.filters.update({name: getattr(units, name) for name in names})
    return environment


def _headline(report: RunReport) -> str:
    if not report.recordings:
        return "no recordings"
    failed = sum(one.status in FAILED for one in report.recordings)
    return (
        f"{counted(len(report.recordings), 'recording')}, {count_text(failed) if failed else 'none'} failed"
    )


def _totals(report: RunReport) -> dict[str, str]:
    totals = [one.totals for one in report.recordings]
    source_bytes = sum(one.source_bytes for one in report.recordings)
    stored_bytes = sum(one.stored_bytes for one in totals)
    return {
        "Recordings": count_text(len(report.recordings)),
        "Messages read": count_text(sum(one.read for one in totals)),
        "Written": count_text(sum(one.written for one in totals)),
        "Rejected": count_text(sum(one.rejected for one in totals)),
        "Unreadable": unreadable_text(report.recordings),
        "Size": f"{bytes_text(source_bytes)}, {stored_text(source_bytes, stored_bytes)}",
        "Working time": seconds_text(sum(one.duration_s for one in report.recordings)),
    }


class _Step(Struct, frozen=True):
    """One step of a run, and its part of a bar from 0 to 1."""

    name: str
    label: str
    seconds: float
    share: float
    start: float


def _steps(seconds: Mapping[str, float], *, stacked: bool = True) -> list[_Step]:
    """Return the steps; `stacked` steps start where the previous one ends. Without any time, there are none."""
    total = sum(seconds.values())
    steps: list[_Step] = []
    start = 0.0
    for name, spent in seconds.items() if total else ():
        steps.append(_Step(name, STEP_WORDS[name], spent, spent / total, start if stacked else 0.0))
        start += spent / total
    return steps


class _Recording:
    """The values of one recording on the page."""

    def __init__(self, at: int, run: RunReport, folder: Path) -> None:
        report = run.recordings[at]
        self.report = report
        self.id = f"r{at}"
        self.is_open = False
        self.status = STATUS_WORDS[report.status]
        self.has_problem = bool(
            report.status not in {RunStatus.COMPLETED, RunStatus.SKIPPED}
            or report.totals.rejected
            or report.unreadable_ranges
        )
        self.written = written_text(report)
        self.unreadable = unreadable_text([report])
        self.search_words = " ".join((report.sequence, *report.files, *(t.target for t in report.topics)))
        stored = f", {stored_text(report.source_bytes, report.totals.stored_bytes)}"
        self.size = f"{bytes_text(report.source_bytes)}{stored if report.totals.stored_bytes else ''}"
        self.messages_per_s = round(report.totals.read / report.duration_s) if report.duration_s else 0
        self.steps = _steps(step_seconds(report.steps))
        self.longest_step = longest_step(report.steps)
        self.quarantined = sum(topic.quarantined for topic in report.topics)
        self.quarantine_link = folder_link(report, folder)
        self.replay_command = replay_command(run, report)
        selected = [topic for topic in report.topics if topic.status is not TopicStatus.EXCLUDED]
        times = [time for topic in selected for time in (topic.start_ns, topic.end_ns) if time is not None]
        span = (min(times), max(times)) if times else (0, 0)
        during = f"from {time_text(span[0])} to {time_text(span[1])} UTC" if times else "no rows"
        self.topics_caption = f"{counted(len(selected), 'topic')}, {during}"
        self.topics = [_Topic(topic, span) for topic in sorted(selected, key=lambda topic: topic.target)]
        self.lists = _lists(report)


class _Topic:
    """The values of one topic on the page."""

    def __init__(self, report: TopicReport, span: tuple[int, int]) -> None:
        self.report = report
        self.drawing = draw_topic(report, span)


def _lists(report: Report) -> dict[str, Sequence[str]]:
    """Return the lists of a recording by title."""
    rejected = [
        f"{topic.target}: {count_text(rejection.count)} at {rejection.stage.value} [{rejection.rule}]: "
        f"{rejection.reason} (first log time {time_text(rejection.first_log_time_ns)}, "
        f"offset {rejection.first_offset})"
        for topic in report.topics
        for rejection in topic.rejections
    ]
    unreadable = [
        f"{item.topic or 'the recording'}: "
        f"{'unknown number of messages' if item.count is None else counted(item.count, 'message')}"
        f"{'' if item.offset is None else f' at offset {item.offset}'}: {item.reason}"
        for item in report.unreadable_ranges
    ]
    quarantined = [
        f"{topic.target}: {counted(topic.quarantined, 'message')}"
        for topic in report.topics
        if topic.quarantined
    ]
    excluded = [
        f"{topic.topic}: {topic.why}" for topic in report.topics if topic.status is TopicStatus.EXCLUDED
    ]
    return {
        "Rejected": rejected,
        "In the quarantine": quarantined,
        "Unreadable": unreadable,
        "Excluded": excluded,
        "Findings": report.findings,
    }


class _RejectionGroup(Struct, frozen=True):
    """The messages of all recordings that were rejected for one reason."""

    stage: str
    rule: str
    messages: int
    recordings: list[_Recording]
    reason: str
    """The first reason, with its recording and topic."""
    quarantines: dict[str, Path]
    """The folders with messages of these recordings, by link."""


def _rejection_groups(recordings: Sequence[_Recording]) -> list[_RejectionGroup]:
    """Return the rejections of all recordings by stage and rule, most messages first."""
    entries: dict[tuple[str, str], list[tuple[_Recording, int, str]]] = defaultdict(list)
    for recording in recordings:
        for topic in recording.report.topics:
            for rejection in topic.rejections:
                reason = f"{recording.report.sequence}{topic.target}: {rejection.reason}"
                key = (rejection.stage.value, rejection.rule)
                entries[key].append((recording, rejection.count, reason))
    groups: list[_RejectionGroup] = []
    for (stage, rule), group in entries.items():
        affected = list(dict.fromkeys(recording for recording, _, _ in group))
        quarantines = {
            recording.quarantine_link: Path(recording.report.quarantine).parent
            for recording in affected
            if recording.quarantine_link is not None and recording.report.quarantine is not None
        }
        messages = sum(count for _, count, _ in group)
        groups.append(_RejectionGroup(stage, rule, messages, affected, group[0][2], quarantines))
    return sorted(groups, key=lambda group: -group.messages)


def draw_topic(topic: TopicReport, span: tuple[int, int]) -> dict[str, Any] | None:
    """Return the drawing of a topic's rows within the recording's first and last time, in ns; None without rows.

    The drawing has a label and the SVG paths of rows and gaps.
    """
    if topic.timeline is None:
        return None
    start_ns, end_ns = span
    scale = WIDTH / (end_ns - start_ns) if end_ns > start_ns else 0.0
    timeline = _with_wider_bins(topic.timeline)
    return {
        "width": WIDTH,
        "height": HEIGHT,
        "label": f"{topic.target}: {counted(topic.written, 'row')}, {_gaps_text(timeline)}",
        "rows": _rows_path(timeline, start_ns, scale),
        "gaps": "".join(_gap_path(gap, start_ns, scale) for gap in timeline.gaps),
    }


def _gaps_text(timeline: TimelineReport) -> str:
    if not timeline.gap_count:
        return "no gaps"
    longest_ns = max((gap.end_ns - gap.start_ns for gap in timeline.gaps), default=0)
    text = counted(timeline.gap_count, "gap")
    return f"{text}, {seconds_text(longest_ns / 1e9)}" + ("" if timeline.gap_count == 1 else " the longest")


def _with_wider_bins(timeline: TimelineReport) -> TimelineReport:
    """Merge bins until each spans several intervals, so that only gaps leave bins empty."""
    bins = len(timeline.counts)
    factor = math.ceil(INTERVALS_PER_BAR * (timeline.interval_ns or 0) / timeline.step_ns)
    factor = max(1, min(factor, bins))
    counts = tuple(sum(timeline.counts[at : at + factor]) for at in range(0, bins, factor))
    return timeline.model_copy(update={"step_ns": timeline.step_ns * factor, "counts": counts})


def _rows_path(timeline: TimelineReport, start_ns: int, scale: float) -> str:
    """Return the outline of all bars as one path; equal neighbors form one bar."""
    bins = len(timeline.counts)
    left, step = (timeline.start_ns - start_ns) * scale, timeline.step_ns * scale
    if bins * step < MIN_BAR:
        left, step = min(max(left, 0.0), WIDTH - MIN_BAR), MIN_BAR / bins
    edges = [min(max(left + number * step, 0.0), WIDTH) for number in range(bins + 1)]
    highest = max(timeline.counts)
    moves = [f"M{edges[0]:.1f} {HEIGHT}"]
    level = 0.0
    for edge, count in zip(edges, timeline.counts, strict=False):
        height = round(count / highest * (HEIGHT - GAP_HEIGHT), 1)
        if height != level:
            moves.append(f"H{edge:.1f}V{HEIGHT - height:g}")
            level = height
    moves.append(f"H{edges[-1]:.1f}V{HEIGHT}Z")
    return "".join(moves)


def _gap_path(gap: Gap, start_ns: int, scale: float) -> str:
    left, right = (gap.start_ns - start_ns) * scale, (gap.end_ns - start_ns) * scale
    return f"M{left:.1f} {HEIGHT - GAP_HEIGHT}H{right:.1f}V{HEIGHT}H{left:.1f}Z"
