"""The report: the numbers of read, written, excluded, rejected and unreadable messages, per topic and in total."""

from __future__ import annotations

import os
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from urllib.parse import quote

from pydantic import computed_field

from mosaico_ingest.documents import html_table
from mosaico_ingest.findings import Finding, Severity, Stage, one_line
from mosaico_ingest.report.contract import ContractResult, Location, ReportPart
from mosaico_ingest.report.events import RunStatus, TopicStatus
from mosaico_ingest.report.timing import TimelineReport, mean_rate_hz
from mosaico_ingest.report.units import bytes_text, count_text, counted, written_cell, written_text


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
        return topic_table(self)

    @computed_field
    @property
    def compression(self) -> float | None:
        """Stored bytes per byte of the recording's files; None if their size is unknown."""
        return round(self.totals.stored_bytes / self.source_bytes, 6) if self.source_bytes else None


def topic_table(report: Report) -> str:
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


def folder_link(one: Report, page_folder: Path) -> str | None:
    """Return the link from a page in `page_folder` to the folder of the quarantine; None if there is none."""
    if one.quarantine is None:
        return None
    folder = os.path.relpath(Path(one.quarantine).absolute().parent, page_folder.absolute())
    return quote(Path(folder).as_posix().encode("utf-8", "surrogateescape")) + "/"
