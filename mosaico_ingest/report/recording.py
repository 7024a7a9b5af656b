"""The report of one recording, and its collection from the events of the run."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from datetime import datetime
from heapq import nlargest
from pathlib import Path
from urllib.parse import quote

from msgspec import Struct, field
from pydantic import computed_field

from mosaico_ingest.display import bytes_text, count_text, counted, mean_rate_hz, written_cell
from mosaico_ingest.documents import html_table
from mosaico_ingest.findings import Finding, Severity, Stage, one_line
from mosaico_ingest.report.events import (
    DOWNSAMPLING,
    CommitStarted,
    ContractEvaluated,
    Event,
    Expected,
    Noted,
    Quarantined,
    Rejected,
    RunFinished,
    RunStarted,
    RunStatus,
    Timed,
    TopicClosed,
    TopicProgress,
    TopicStatus,
    Unreadable,
)
from mosaico_ingest.report.parts import ContractResult, Location, ReportPart, Stopwatch, TimelineReport

STEP_WORDS = {
    "prepare": "opening and planning",
    "read": "reading",
    "decode": "decoding",
    "adapt": "adapting",
    "wait": "waiting for the writer",
    "commit": "committing",
}
"""The steps of a run in the order of the pipeline; `write` is missing because it runs in parallel to them."""
MAX_STRETCHES = 50
"""Maximum number of stretches that a rejection lists."""


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

    @property
    def written_text(self) -> str:
        """The number of written messages, out of the messages read or, if the run stopped early, of the recording."""
        totals = self.totals
        promised = sum(topic.promised or 0 for topic in self.counted_topics)
        if self.status in {RunStatus.FAILED, RunStatus.INTERRUPTED} and promised > totals.read:
            return f"{counted(totals.written, 'message')} written before the run stopped, of {count_text(promised)}"
        rows = "" if totals.rows == totals.written else f" as {counted(totals.rows, 'row')}"
        return f"{count_text(totals.written)} of {counted(totals.read, 'message')} written{rows}"

    def __repr__(self) -> str:
        """Return the outcome, such as `<Report yard: completed, 2,110 of 2,110 messages written>`."""
        outcome = self.error or self.written_text
        return one_line(f"<Report {self.sequence}: {self.status.value}, {outcome}>")

    def _repr_html_(self) -> str:
        """Return a table of the topics for a notebook."""
        return topic_table(self)

    @computed_field
    @property
    def compression(self) -> float | None:
        """Stored bytes per byte of the recording's files; None if their size is unknown."""
        return round(self.totals.stored_bytes / self.source_bytes, 6) if self.source_bytes else None


def unreadable_text(report: Report) -> str:
    """Return the number of unreadable messages, such as `12`, `at least 12` or `unknown`."""
    counts = [item.count for item in report.unreadable_ranges]
    total = sum(count or 0 for count in counts)
    return at_least_text(total) if None in counts else count_text(total)


def at_least_text(count: int) -> str:
    """Return a number to which an unknown one is added, such as `at least 12` or `unknown`."""
    return f"at least {count_text(count)}" if count else "unknown"


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


def step_seconds(steps: Steps) -> dict[str, float]:
    """Return the seconds of each sequential step."""
    return {name: float(getattr(steps, name)) for name in STEP_WORDS}


def longest_step(steps: Steps) -> str:
    """Return the longest step of a recording and its share of the time, such as `reading, 62%`."""
    seconds = step_seconds(steps)
    name = max(seconds, key=lambda step: seconds[step])
    total = sum(seconds.values())
    return f"{STEP_WORDS[name]}, {seconds[name] / total:.0%}" if total else ""


def slowest(recordings: Sequence[Report], most: int) -> list[tuple[int, Report]]:
    """Return the recordings with the longest duration, with their positions; untimed recordings are excluded."""
    timed = ((at, one) for at, one in enumerate(recordings) if any(step_seconds(one.steps).values()))
    return nlargest(most, timed, key=lambda one: one[1].duration_s)


class Collector:
    """An observer that collects the events of one recording into a report."""

    def __init__(self, watch: Stopwatch | None = None) -> None:
        self._watch = watch or Stopwatch()
        self._start = RunStarted(sequence="", destination="", files=(), source_bytes=0, topics=())
        self._sums: dict[str, _Sum] = defaultdict(_Sum)
        self._unreadable: list[UnreadableRange] = []
        self._findings: list[str] = []
        self._steps = Steps()
        self._quarantine: str | None = None
        self._contract: ContractResult | None = None
        self._finish = RunFinished(status=RunStatus.FAILED, exit_code=1)

    def __call__(self, event: Event) -> None:  # noqa: C901 - one case per event
        """Add an event."""
        match event:
            case TopicProgress() | Rejected() | TopicClosed():
                self._sums[event.target].take(event)
            case RunStarted():
                self._start = event
            case Unreadable():
                if event.target is not None:
                    self._sums[event.target].unreadable += event.count or 0
                self._unreadable.append(
                    UnreadableRange(
                        topic=event.target,
                        count=event.count,
                        offset=event.offset,
                        reason=event.reason,
                        start_ns=event.start_ns,
                        end_ns=event.end_ns,
                    )
                )
            case Noted():
                self._findings.append(str(event.finding))
            case ContractEvaluated():
                self._contract = event.result
            case Quarantined():
                self._quarantine = event.messages
            case CommitStarted():
                pass
            case Timed():
                self._steps = Steps(**{step.value: round(s, 6) for step, s in event.seconds.items()})
            case RunFinished():
                self._finish = event

    @property
    def rejected(self) -> int:
        """Number of messages rejected so far."""
        return sum(r.count for s in self._sums.values() for r in s.rejections.values())

    @property
    def contract(self) -> ContractResult | None:
        """The results of the data contract, if it was evaluated."""
        return self._contract

    @property
    def unreadable(self) -> bool:
        """True if a range of the recording could not be read."""
        return bool(self._unreadable)

    def report(self) -> Report:
        """Return the report so far; it is complete after `RunFinished`."""
        return Report(
            sequence=self._start.sequence,
            destination=self._start.destination,
            files=self._start.files,
            status=self._finish.status,
            exit_code=self._finish.exit_code,
            error=self._finish.error,
            started_at=self._watch.began_at,
            duration_s=round(self._watch.elapsed_s, 6),
            source_bytes=self._start.source_bytes,
            steps=self._steps,
            quarantine=self._quarantine,
            contract=self._contract,
            topics=tuple(self._topic(topic) for topic in self._start.topics),
            unreadable_ranges=tuple(self._unreadable),
            findings=tuple(self._findings),
            error_findings=tuple(map(ErrorFinding.of, self._finish.findings)),
        )

    def _unread(self, expected: Expected) -> _Sum:
        counts = (item.count or 0 for item in self._unreadable if item.topic == expected.topic)
        return _Sum(unreadable=sum(counts))

    def _unreadable_in(self, expected: Expected) -> int:
        """Return the number of unreadable messages of a topic; ranges are reported for one of the topics that share them."""
        targets = (
            other.target
            for other in self._start.topics
            if (other.topic, other.msgtype) == (expected.topic, expected.msgtype)
            and not (other.excluded or other.shares_messages)
        )
        return self._sums[next(targets, expected.target)].unreadable

    def _topic(self, expected: Expected) -> TopicReport:
        total = self._sums[expected.target] if not expected.excluded else self._unread(expected)
        rejections = tuple(
            rejection.replace(stretches=_stretches(total.stretches.get(key, ())))
            for key, rejection in total.rejections.items()
        )
        return TopicReport(
            topic=expected.topic,
            target=expected.target,
            msgtype=expected.msgtype,
            adapter=expected.adapter,
            ontology=expected.ontology,
            why=expected.why,
            status=_status(expected, total),
            promised=expected.count,
            shares_messages=expected.shares_messages,
            unreadable=self._unreadable_in(expected) if expected.shares_messages else total.unreadable,
            read=total.read,
            written=total.written,
            rows=total.rows,
            filtered=sum(count for rule, count in total.dropped.items() if rule not in DOWNSAMPLING),
            downsampled=sum(total.dropped[rule] for rule in DOWNSAMPLING),
            dropped={rule: count for rule, count in total.dropped.items() if count},
            latched=total.latched,
            stamp_fallbacks=total.stamp_fallbacks,
            rejected=sum(rejection.count for rejection in rejections),
            quarantined=total.quarantined,
            rejections=rejections,
            start_ns=total.start_ns if total.rows else None,
            end_ns=total.end_ns if total.rows else None,
            payload_bytes=total.payload_bytes,
            stored_bytes=(total.closed.stored_bytes or 0) if total.closed else 0,
            checksum=total.closed.checksum if total.closed else None,
            error=total.closed.error if total.closed else None,
            timeline=total.closed.timeline if total.closed and total.rows else None,
        )


class _Sum(Struct):
    unreadable: int = 0
    quarantined: int = 0
    read: int = 0
    written: int = 0
    rows: int = 0
    dropped: Counter[str] = field(default_factory=Counter[str])
    latched: int = 0
    stamp_fallbacks: int = 0
    payload_bytes: int = 0
    start_ns: int | None = None
    end_ns: int | None = None
    rejections: dict[tuple[Stage, str], Rejection] = field(default_factory=dict[tuple[Stage, str], Rejection])
    stretches: dict[tuple[Stage, str], list[tuple[int, int]]] = field(default_factory=dict)
    closed: TopicClosed | None = None

    def take(self, event: TopicProgress | Rejected | TopicClosed) -> None:
        if isinstance(event, TopicProgress):
            self._add(event)
        elif isinstance(event, Rejected):
            self._reject(event)
        else:
            self.closed = event

    def _add(self, more: TopicProgress) -> None:
        self.read += more.read
        self.written += more.written
        self.rows += more.rows
        self.dropped.update(more.dropped)
        self.latched += more.latched
        self.stamp_fallbacks += more.stamp_fallbacks
        self.payload_bytes += more.payload_bytes
        if more.start_ns is not None:
            self.start_ns = more.start_ns if self.start_ns is None else min(self.start_ns, more.start_ns)
        if more.end_ns is not None:
            self.end_ns = more.end_ns if self.end_ns is None else max(self.end_ns, more.end_ns)

    def _reject(self, event: Rejected) -> None:
        self.quarantined += event.quarantined
        key = (event.stage, event.rule)
        if event.last_log_time_ns is not None:
            stretches = self.stretches.setdefault(key, [])
            stretches.append((event.first_log_time_ns, event.last_log_time_ns))
            if len(stretches) > 2 * MAX_STRETCHES:
                self.stretches[key] = _merged(stretches)
        rejection = self.rejections.get(key)
        if rejection is None:
            self.rejections[key] = Rejection(
                stage=event.stage,
                rule=event.rule,
                count=event.count,
                reason=event.reason,
                first_log_time_ns=event.first_log_time_ns,
                first_offset=event.first_offset,
            )
        else:
            self.rejections[key] = rejection.model_copy(update={"count": rejection.count + event.count})


def _merged(stretches: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return pairs of neighbors as one stretch each, in half as many stretches."""
    ordered = sorted(stretches)
    pairs = [ordered[at : at + 2] for at in range(0, len(ordered), 2)]
    return [(pair[0][0], max(end for _, end in pair)) for pair in pairs]


def _stretches(stretches: Sequence[tuple[int, int]]) -> tuple[Stretch, ...]:
    while len(stretches) > MAX_STRETCHES:
        stretches = _merged(stretches)
    return tuple(Stretch(start_ns=start, end_ns=end) for start, end in sorted(stretches))


def _status(expected: Expected, total: _Sum) -> TopicStatus:
    if expected.excluded:
        return TopicStatus.EXCLUDED
    if total.closed is not None:
        return total.closed.status
    return TopicStatus.WRITTEN if total.rows else TopicStatus.EMPTY
