"""The report: the numbers of read, written, excluded, rejected and unreadable messages, per topic and in total."""

from __future__ import annotations

import os
import shlex
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import quote

from pydantic import AfterValidator, Field, computed_field
from typing_extensions import Self

from mosaico_ingest.documents import document_schema
from mosaico_ingest.findings import Finding, Severity, Stage, one_line
from mosaico_ingest.notebook import html_table
from mosaico_ingest.report.contract import ContractResult, Location, ReportPart
from mosaico_ingest.report.events import RunStatus, TopicStatus
from mosaico_ingest.report.timing import TimelineReport, mean_rate_hz
from mosaico_ingest.report.units import bytes_text, count_text, counted, written_cell, written_text

_GRAVEST_FIRST = (130, 5, 1, 2, 6, 3, 4)
UNSUCCESSFUL = (RunStatus.FAILED, RunStatus.INTERRUPTED, RunStatus.DIVERTED)
"""Statuses of recordings that were not stored as the job demands."""


class Stretch(ReportPart):
    """A range of time, both ends inclusive."""

    start_ns: int
    """First log time, in ns since the epoch."""
    end_ns: int
    """Last log time, in ns since the epoch."""


class Rejection(ReportPart):
    """Messages of one topic that were rejected for the same reason."""

    stage: Stage
    """The stage that rejected the messages."""
    rule: str
    """The id of the rule that the messages violate."""
    count: int
    """Number of messages."""
    reason: str
    """The reason for the first message."""
    first_log_time_ns: int
    """Log time of the first message, in ns since the epoch."""
    first_offset: int
    """Location of the first message in the recording: file offset of its record or chunk, or row id."""
    stretches: tuple[Stretch, ...] = ()
    """Ranges of log times in which messages were rejected, ordered by time; neighbors are merged beyond 50."""


class UnreadableRange(ReportPart):
    """A range of the recording from which messages could not be read."""

    topic: str | None
    """The topic; None if it is unknown."""
    count: int | None
    """Number of unreadable messages; None if it is unknown."""
    offset: int | None
    """File offset or row id; None if it is unknown."""
    reason: str
    """What was expected and what the file contains."""
    start_ns: int | None = None
    """First log time of the range according to the recording's index; None if it is unknown."""
    end_ns: int | None = None
    """Last log time of the range according to the recording's index, inclusive; None if it is unknown."""


class TopicReport(ReportPart):
    """One topic: read = written + filtered + downsampled + rejected.

    If the recording was read completely, promised = read + unreadable.
    """

    topic: str
    """The name in the recording."""
    target: str
    """The name in the sequence."""
    msgtype: str
    adapter: str
    ontology: str
    """The ontology tag of the rows."""
    why: str
    """The reason for the adapter, or for the exclusion of the topic."""
    status: TopicStatus
    promised: int | None
    """Number of messages in the index of the recording; None if it is unknown."""
    unreadable: int = 0
    """Number of messages that could not be read, as far as it is known; see `unreadable_ranges`."""
    read: int = 0
    written: int = 0
    """Number of messages that became rows, in this topic or another output of its adapter."""
    rows: int = 0
    """Number of rows; it differs from `written` if the adapter has `rows` or several outputs."""
    shares_messages: bool = False
    """True if another topic counts the same messages, because the adapter has several outputs; totals count them once."""
    filtered: int = 0
    """Number of messages that `where`, `on_change`, the time range or the adapter dropped after they were read."""
    downsampled: int = 0
    """Number of messages that `every` or `rate` dropped."""
    dropped: Mapping[str, int] = {}
    """Number of filtered and downsampled messages by rule: `every`, `rate`, `where`, `on_change`, `time_range`, and of the
    adapter `drop_when` and `rows` (an empty list)."""
    latched: int = 0
    """Number of messages from before the time range, see `bag.time.include_latched`."""
    stamp_fallbacks: int = 0
    """Number of messages that have their log time, because they do not have the time that `stamp` selects."""
    rejected: int = 0
    quarantined: int = 0
    """Number of rejected messages in the quarantine."""
    rejections: tuple[Rejection, ...] = ()
    start_ns: int | None = None
    """The first timestamp of the rows, in ns since the epoch."""
    end_ns: int | None = None
    """The last timestamp of the rows, in ns since the epoch, inclusive."""
    payload_bytes: int = 0
    """Serialized bytes of the messages read."""
    stored_bytes: int = 0
    """Bytes of the rows in the destination, as far as it reports them."""
    checksum: str | None = None
    """XXH3 checksum (128 bits) of the row values; None if the destination has none. `ingest verify` computes it again."""
    error: str | None = None
    timeline: TimelineReport | None = None
    """The distribution of the written rows over time."""

    @computed_field
    @property
    def rate_hz(self) -> float | None:
        """Rows per second; see `mean_rate_hz`."""
        rate = mean_rate_hz(self.rows, self.start_ns, self.end_ns)
        return None if rate is None else round(rate, 6)


class Totals(ReportPart):
    """Sums over the topics that were read."""

    promised: int | None
    """Number of messages in the index; None if the index does not count the messages of every topic."""
    unreadable: int | None
    """Number of messages in unreadable ranges; None if the number is unknown for a range."""
    read: int
    written: int
    rows: int
    """Number of rows in all topics."""
    filtered: int
    downsampled: int
    rejected: int
    payload_bytes: int
    stored_bytes: int


class Steps(ReportPart):
    """Seconds per step of a run; all steps but `write` add up to its duration."""

    prepare: float = 0
    """Opening and planning the recording, and inspecting the destination."""
    read: float = 0
    """Reading and decompressing, as far as decoding had to wait."""
    decode: float = 0
    """Decoding bytes into columns of the ROS type."""
    adapt: float = 0
    """Converting columns of the ROS type into columns of the ontology type."""
    wait: float = 0
    """Waiting for the writing thread."""
    commit: float = 0
    """Finishing, committing and verifying the sequence."""
    write: float = 0
    """Time that the writing thread was busy, in parallel to the other steps."""


class ErrorFinding(ReportPart):
    """A finding that ended the run of a recording."""

    rule: str
    severity: Severity
    message: str
    help: str | None = None
    location: Location | None = None
    """The location in the manifest or another text; None if it is unknown."""

    @classmethod
    def of(cls, finding: Finding) -> ErrorFinding:
        """Return a finding as a part of a report."""
        span = finding.span
        location = None if span is None else Location.of(span)
        return cls(
            rule=finding.rule,
            severity=finding.severity,
            message=finding.message,
            help=finding.help,
            location=location,
        )

    @property
    def finding(self) -> Finding:
        """The finding."""
        span = None if self.location is None else self.location.span
        return Finding(self.rule, self.severity, self.message, span, self.help)


class Report(ReportPart):
    """The result of one recording."""

    sequence: str
    destination: str
    files: tuple[str, ...]
    status: RunStatus
    exit_code: int
    error: str | None = None
    """The error that ended the run, in one line."""
    started_at: datetime
    duration_s: float
    source_bytes: int
    """Bytes of the recording's files."""
    steps: Steps = Steps()
    quarantine: str | None = None
    """The file with the rejected messages."""
    contract: ContractResult | None = None
    """The results of the data contract; None without a contract, or if the recording was not read completely."""
    topics: tuple[TopicReport, ...] = ()
    unreadable_ranges: tuple[UnreadableRange, ...] = ()
    findings: tuple[str, ...] = ()
    """The findings of the run, one line each."""
    error_findings: tuple[ErrorFinding, ...] = ()
    """The findings that `error` summarizes, with their locations."""

    @computed_field
    @property
    def totals(self) -> Totals:
        """Sums over the topics that were read."""
        topics = self.counted_topics
        promised = [topic.promised for topic in topics]
        unreadable = [item.count for item in self.unreadable_ranges]
        return Totals(
            promised=None if None in promised else sum(count or 0 for count in promised),
            unreadable=None if None in unreadable else sum(count or 0 for count in unreadable),
            read=sum(t.read for t in topics),
            written=sum(t.written for t in topics),
            rows=sum(t.rows for t in self.topics),
            filtered=sum(t.filtered for t in topics),
            downsampled=sum(t.downsampled for t in topics),
            rejected=sum(t.rejected for t in topics),
            payload_bytes=sum(t.payload_bytes for t in topics),
            stored_bytes=sum(t.stored_bytes for t in self.topics),
        )

    @property
    def counted_topics(self) -> list[TopicReport]:
        """The topics that were read, except topics that share their messages with another topic."""
        return [
            topic
            for topic in self.topics
            if topic.status is not TopicStatus.EXCLUDED and not topic.shares_messages
        ]

    def __repr__(self) -> str:
        """Return the outcome, such as `<Report yard: completed, 2,110 of 2,110 messages written>`."""
        outcome = self.error or written_text(self)
        return one_line(f"<Report {self.sequence}: {self.status.value}, {outcome}>")

    def _repr_html_(self) -> str:
        """Return a table of the topics for a notebook."""
        return _topic_table(self)

    @computed_field
    @property
    def compression(self) -> float | None:
        """Stored bytes per byte of the recording's files; None if their size is unknown."""
        return round(self.totals.stored_bytes / self.source_bytes, 6) if self.source_bytes else None


class UsedManifest(ReportPart):
    """A manifest of the run, as it was at the start."""

    path: str
    text: str
    """The manifest as YAML, with `extends` resolved and without secrets."""


class Summary(ReportPart):
    """Sums over the recordings of a run."""

    statuses: Mapping[RunStatus, int] = Field(default={})
    """Number of recordings by status."""
    read: int = 0
    written: int = 0
    filtered: int = 0
    downsampled: int = 0
    rejected: int = 0
    unreadable: int = 0
    """Number of unreadable messages, as far as it is known."""
    source_bytes: int = 0
    stored_bytes: int = 0
    duration_s: float = 0
    """Time spent on recordings; recordings that run at the same time add up."""
    steps: Steps = Steps()
    started_at: datetime | None = None
    """The time when the first recording started; None without recordings."""
    ended_at: datetime | None = None
    """The time when the last recording ended."""
    exit_code: int = 0
    """The first of 130, 5, 1, 2, 6, 3, 4, 0 that any recording produced."""
    resumed: int = 0
    """Number of recordings that an earlier run of the report finished and that the last run did not ingest again."""

    @property
    def recordings(self) -> int:
        """Number of recordings."""
        return sum(self.statuses.values())

    @property
    def headline(self) -> str:
        """The numbers of recordings by outcome and of written messages, in one line."""
        failed = sum(self.statuses.get(status, 0) for status in UNSUCCESSFUL)
        skipped = self.statuses.get(RunStatus.SKIPPED, 0)
        parts = [counted(self.recordings, "recording"), f"{count_text(failed)} failed"]
        parts += [f"{count_text(self.resumed)} from earlier runs"] if self.resumed else []
        parts += [f"{count_text(skipped)} skipped"] if skipped else []
        return f"{', '.join(parts)}, {counted(self.written, 'message')} written"


@dataclass(slots=True)
class RunningSummary:
    """The sums over the recordings that have ended so far."""

    _statuses: Counter[RunStatus] = field(default_factory=Counter[RunStatus])
    _counts: Counter[str] = field(default_factory=Counter[str])
    _seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(Steps.model_fields, 0.0))
    _duration_s: float = 0
    _codes: set[int] = field(default_factory=set[int])
    _started_at: datetime | None = None
    _ended_at: datetime | None = None

    def add(self, report: Report) -> None:
        """Add the report of a recording."""
        totals = report.totals
        self._statuses[report.status] += 1
        self._codes.add(report.exit_code)
        for name in ("read", "written", "filtered", "downsampled", "rejected", "stored_bytes"):
            self._counts[name] += getattr(totals, name)
        self._counts["unreadable"] += sum(item.count or 0 for item in report.unreadable_ranges)
        self._counts["source_bytes"] += report.source_bytes
        for name in self._seconds:
            self._seconds[name] += getattr(report.steps, name)
        self._duration_s += report.duration_s
        ended_at = report.started_at + timedelta(seconds=report.duration_s)
        self._started_at = min(self._started_at or report.started_at, report.started_at)
        self._ended_at = max(self._ended_at or ended_at, ended_at)

    def summary(self) -> Summary:
        """Return the sums so far."""
        return Summary(
            statuses=dict(self._statuses),
            **self._counts,
            duration_s=round(self._duration_s, 6),
            steps=Steps(**{name: round(seconds, 6) for name, seconds in self._seconds.items()}),
            started_at=self._started_at,
            ended_at=self._ended_at,
            exit_code=gravest(self._codes),
        )


def summarize(recordings: Iterable[Report]) -> Summary:
    """Return the sums over recordings."""
    running = RunningSummary()
    for recording in recordings:
        running.add(recording)
    return running.summary()


class RunReport(ReportPart):
    """The report of one run, with a part for each recording; `version` changes with the format."""

    version: Literal[1] = 1
    tool: str
    """Name and version of the program that wrote the report."""
    manifests: tuple[UsedManifest, ...] = ()
    recordings: Annotated[Sequence[Report], AfterValidator(tuple)]
    """The result of each recording. If the report is a file in JSON Lines, each access reads the recording."""

    @computed_field
    @cached_property
    def summary(self) -> Summary:
        """The sums over all recordings."""
        return summarize(self.recordings)

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy; the sums are computed again if the recordings differ."""
        copy = super().model_copy(update=update, deep=deep)
        if update is not None and "recordings" in update:
            vars(copy).pop("summary", None)
        return copy

    def with_summary(self, summary: Summary) -> Self:
        """Return the report with sums that were computed before."""
        return self.model_copy(update={"summary": summary})

    @property
    def headline(self) -> str:
        """The numbers of recordings by outcome and of written messages, in one line."""
        return self.summary.headline

    @computed_field
    @property
    def exit_code(self) -> int:
        """The first of 130, 5, 1, 2, 6, 3, 4, 0 that any recording produced."""
        return self.summary.exit_code

    def __repr__(self) -> str:
        """Return the outcome, such as `<RunReport: 2 recordings, 0 failed, 4,220 messages written>`."""
        return f"<RunReport: {self.headline}>"

    def _repr_html_(self) -> str:
        """Return a table of the recordings for a notebook, or of the topics of a single recording."""
        if len(self.recordings) == 1:
            return _topic_table(self.recordings[0])
        rows = (
            (
                each.sequence,
                each.status.value,
                *(
                    count_text(count)
                    for count in (each.totals.read, each.totals.written, each.totals.rejected)
                ),
                each.error or "",
            )
            for each in self.recordings
        )
        names = ("sequence", "status", "read", "written", "rejected", "error")
        return html_table(
            self.headline, names, rows, count=len(self.recordings), numbers={"read", "written", "rejected"}
        )


def _topic_table(report: Report) -> str:
    """Return the topics that were read as a table for a notebook."""
    topics = [topic for topic in report.topics if topic.status is not TopicStatus.EXCLUDED]
    excluded = len(report.topics) - len(topics)
    rows = (
        (
            topic.target,
            topic.ontology,
            count_text(topic.read),
            written_cell(topic.written, topic.rows),
            count_text(topic.rejected),
            bytes_text(topic.stored_bytes),
        )
        for topic in topics
    )
    names = ("topic", "ontology", "read", "written", "rejected", "stored")
    notes = [*([f"excluded: {counted(excluded, 'topic')}"] if excluded else []), *report.findings]
    return html_table(repr(report)[1:-1], names, rows, count=len(topics), numbers=names[2:], notes=notes)


def gravest(codes: Collection[int]) -> int:
    """Return the exit code of a run whose recordings have these exit codes."""
    return next((code for code in _GRAVEST_FIRST if code in codes), max(codes, default=0))


def report_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a report file."""
    return document_schema(RunReport)


def replay_command(report: RunReport, one: Report) -> str | None:
    """Return the command that replays the quarantine of a recording; None if it has none."""
    if one.quarantine is None:
        return None
    manifests = [manifest.path for manifest in report.manifests]
    job = shlex.quote(manifests[0]) if len(manifests) == 1 else "JOB.yaml"
    return f"ingest replay {shlex.quote(str(Path(one.quarantine).parent))} --manifest {job}"


def folder_link(one: Report, page_folder: Path) -> str | None:
    """Return the link from a page in `page_folder` to the folder of the quarantine; None if there is none."""
    if one.quarantine is None:
        return None
    folder = os.path.relpath(Path(one.quarantine).absolute().parent, page_folder.absolute())
    return quote(Path(folder).as_posix().encode("utf-8", "surrogateescape")) + "/"
