"""Collection of the events of one recording into its report, and the time of its steps."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

from mosaico_ingest.findings import Stage
from mosaico_ingest.report.contract import ContractResult
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
from mosaico_ingest.report.model import (
    ErrorFinding,
    Rejection,
    Report,
    Steps,
    Stretch,
    TopicReport,
    UnreadableRange,
)
from mosaico_ingest.report.timing import Stopwatch

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
    timed = [(at, one) for at, one in enumerate(recordings) if any(step_seconds(one.steps).values())]
    return sorted(timed, key=lambda found: -found[1].duration_s)[:most]


@dataclass(slots=True)
class _Sum:
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
