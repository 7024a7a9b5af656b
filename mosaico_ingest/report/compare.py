"""Comparison of two reports: new and missing recordings and topics, and changed rates, sizes and speeds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.report.events import RunStatus, TopicStatus
from mosaico_ingest.report.files import RunReport
from mosaico_ingest.report.model import Report, TopicReport
from mosaico_ingest.report.units import bytes_text, count_text, counted

RATE_CHANGE = 0.05
"""Share by which the rate of a topic must change to be listed."""
SIZE_CHANGE = 0.10
"""Share by which the stored size per row must change to be listed."""
SPEED_CHANGE = 0.25
"""Share by which the messages per second of a run must change to be listed."""
MAX_CHANGES = 500
"""Maximum number of changes of a comparison."""
ALL = "all recordings"


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
