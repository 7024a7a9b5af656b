"""The results of a contract: from what the monitors observed, from the index, and from the recordings of a group."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from fnmatch import fnmatchcase
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct

from mosaico_ingest.contracts import (
    HEADER_KEYS,
    Clause,
    Contract,
    bounds_text,
    duration_text,
    extremes_text,
    instant_text,
    limit_text,
    number_text,
    occurrence,
    other_types,
    part_text,
    share_text,
)
from mosaico_ingest.contracts.row_results import field_result, header_result
from mosaico_ingest.contracts.times import FileOrder, Gaps, RecorderEvents, Windows, covered_ns, uncovered_ns
from mosaico_ingest.display import count_text, counted, mean_rate_hz
from mosaico_ingest.job.values import RECORDING, Limit
from mosaico_ingest.report.parts import ContractResult, ExpectationResult

if TYPE_CHECKING:
    from mosaico_ingest.contracts.monitor import TopicMonitor


class TopicFacts:
    """The facts about one topic of the recording that expectations are compared with."""

    def __init__(
        self,
        name: str,
        msgtypes: tuple[str, ...],
        *,
        count: int | None,
        monitor: TopicMonitor | None = None,
        unread: str | None = None,
        is_output: bool = False,
    ) -> None:
        self.name = name
        self.msgtypes = msgtypes
        self.count = count
        """Number of messages; None if it is unknown."""
        self.monitor = monitor
        """None if the topic was not read."""
        self.unread = unread
        """The reason why the topic was not read."""
        self.is_output = is_output
        """Whether the topic is an output of an adapter, whose messages another topic counts."""


class Facts:
    """The facts about a recording after it was read, or from its index."""

    def __init__(
        self,
        topics: Mapping[str, TopicFacts],
        *,
        start_ns: int | None,
        end_ns: int | None,
        read_events: Callable[[], RecorderEvents] = RecorderEvents,
        order: FileOrder | None = None,
        connections: Mapping[str, tuple[int, ...]] | None = None,
    ) -> None:
        self.topics = topics
        self.start_ns = start_ns
        self.end_ns = end_ns
        self._read_events = read_events
        self.order = order
        self.connections = connections or {}

    @cached_property
    def events(self) -> RecorderEvents:
        """The events of the recorder, read when they are first needed."""
        return self._read_events()

    @property
    def count(self) -> int | None:
        """Number of messages of all topics; None if it is unknown."""
        counts = [topic.count for topic in self.topics.values() if not topic.is_output]
        return None if None in counts else sum(count or 0 for count in counts)

    def span_of(self, name: str) -> tuple[int, int] | None:
        """Return the first and last log time of the recording or of a topic; None if there is no message."""
        if name == RECORDING:
            return None if self.start_ns is None or self.end_ns is None else (self.start_ns, self.end_ns)
        topic = self.topics.get(name)
        times = None if topic is None or topic.monitor is None else topic.monitor.times
        if times is None or times.first_ns is None or times.last_ns is None:
            return None
        return times.first_ns, times.last_ns


def evaluate(
    contract: Contract, facts: Facts, recording_results: Mapping[str, Callable[[Clause], ExpectationResult]]
) -> ContractResult:
    """Return the results of all expectations.

    `recording_results` evaluates the expectations of the recording that need more than its topics, by key.
    """
    results: list[ExpectationResult] = list(contract.group)
    for clause in contract.recording_clauses():
        special = recording_results.get(clause.key)
        results.append(special(clause) if special else _recording_result(clause, facts))
    results += [_required(pattern, clause, facts) for pattern, clause in contract.pattern_clauses("required")]
    results += [
        _forbidden(pattern, clause, facts) for pattern, clause in contract.pattern_clauses("forbidden")
    ]
    for topic in facts.topics.values():
        results += _topic_results(contract, topic, facts)
    return ContractResult(on_failure=contract.expect.on_failure.value, results=tuple(results))


def _recording_result(clause: Clause, facts: Facts) -> ExpectationResult:
    expected = clause.expected
    if clause.key == "messages":
        return _count_result(clause, facts.count, "the recording has")
    if facts.start_ns is None or facts.end_ns is None:
        return clause.failed("the recording has no message")
    if clause.key == "duration":
        length = facts.end_ns - facts.start_ns
        limit = bounds_text(_or_none(duration_text, expected.min), _or_none(duration_text, expected.max))
        is_good = _within(length, expected.min, expected.max)
        text = f"the recording lasts {duration_text(length)}; expected {limit}"
        return _result(clause, is_good, text, measured=length, unit="ns", limit=limit)
    moment = facts.start_ns if clause.key == "start" else facts.end_ns
    is_good = (expected.after is None or moment >= expected.after) and (
        expected.before is None or moment < expected.before
    )
    limit = " and ".join(
        f"{name} {instant_text(bound)}"
        for name, bound in (("not before", expected.after), ("before", expected.before))
        if bound is not None
    )
    verb = "starts" if clause.key == "start" else "ends"
    text = f"the recording {verb} at {instant_text(moment)}; expected {limit}"
    return _result(clause, is_good, text, measured=moment, unit="ns", limit=limit)


def _required(pattern: str, clause: Clause, facts: Facts) -> ExpectationResult:
    matches = [topic for topic in facts.topics.values() if fnmatchcase(topic.name, pattern)]
    present = [topic for topic in matches if topic.count != 0]
    if present:
        text = f"{pattern!r} matches {counted(len(present), 'topic')} with messages"
        return clause.passed(text, measured=len(present), unit="topics", limit="at least 1 topic")
    if matches:
        text = f"{pattern!r} matches only topics without messages: {', '.join(t.name for t in matches[:5])}"
    else:
        near = get_close_matches(pattern, facts.topics, n=1, cutoff=0.5)
        nearest = f"; the nearest is {near[0]}" if near else ""
        text = f"no topic matches {pattern!r}{nearest}"
    return clause.failed(text, measured=0, unit="topics", limit="at least 1 topic")


def _forbidden(pattern: str, clause: Clause, facts: Facts) -> ExpectationResult:
    present = [
        topic.name for topic in facts.topics.values() if fnmatchcase(topic.name, pattern) and topic.count != 0
    ]
    if not present:
        return clause.passed(
            f"no topic with messages matches {pattern!r}", measured=0, unit="topics", limit="no topic"
        )
    more = f" and {len(present) - 5} more" if len(present) > 5 else ""  # noqa: PLR2004 - names in one line
    text = f"{pattern!r} matches {', '.join(present[:5])}{more}; expected no topic"
    return clause.failed(
        text, measured=len(present), unit="topics", limit="no topic", violations=len(present)
    )


def _topic_results(contract: Contract, topic: TopicFacts, facts: Facts) -> Iterator[ExpectationResult]:
    for clause in contract.topic_clauses(topic.name).values():
        yield _topic_result(clause, topic, facts)
    for _, _, of_field in contract.field_clauses(topic.name):
        for clause in of_field:
            if topic.monitor is None:
                yield clause.skipped(topic.unread or "the topic is not read")
            else:
                yield field_result(clause, list(topic.monitor.rows.values()))


def _topic_result(clause: Clause, topic: TopicFacts, facts: Facts) -> ExpectationResult:
    key, monitor = clause.key, topic.monitor
    if key == "type":
        result = _type_result(clause, topic)
    elif key == "messages":
        result = _count_result(clause, topic.count, "the topic has")
    elif monitor is None:
        result = clause.skipped(topic.unread or "the topic is not read")
    elif key == "rejected":
        result = _rejected(clause, monitor)
    elif key == "out_of_order":
        result = _out_of_order(clause, topic, facts)
    elif key in HEADER_KEYS:
        result = _header(clause, topic, facts)
    else:
        result = _time_result(clause, monitor, facts)
    return result


def _type_result(clause: Clause, topic: TopicFacts) -> ExpectationResult:
    wrong = other_types(clause.expected, topic.msgtypes)
    limit = " or ".join(clause.expected.one_of)
    measured = ", ".join(topic.msgtypes)
    return _result(
        clause, not wrong, f"the type is {measured}; expected {limit}", measured=measured, limit=limit
    )


def _count_result(clause: Clause, count: int | None, subject: str) -> ExpectationResult:
    if count is None:
        return clause.skipped("the index does not count the messages")
    expected = clause.expected
    limit = bounds_text(_or_none(count_text, expected.min), _or_none(count_text, expected.max))
    text = f"{subject} {counted(count, 'message')}; expected {limit}"
    is_good = _within(count, expected.min, expected.max)
    return _result(clause, is_good, text, measured=count, unit="messages", limit=limit)


def _rejected(clause: Clause, monitor: TopicMonitor) -> ExpectationResult:
    if monitor.rejected is None:
        return clause.skipped("the messages are not converted")
    return limit_result(clause, clause.expected.max, monitor.rejected, monitor.read, "messages were rejected")


def limit_result(
    clause: Clause,
    limit: Limit,
    count: int,
    total: int,
    what: str,
    **details: Any,  # noqa: ANN401 - fields
) -> ExpectationResult:
    """Return the result of an expectation that limits a number or share of messages."""
    is_good = limit.allows(count, total)
    text = f"{part_text(limit, count, total, what)}; expected {limit_text(limit)}"
    unit = "messages" if limit.share is None else "share"
    details = {"measured": limit.measure(count, total), "unit": unit, "limit": limit_text(limit), **details}
    return _result(clause, is_good, text, violations=0 if is_good else count, **details)


def _out_of_order(clause: Clause, topic: TopicFacts, facts: Facts) -> ExpectationResult:
    if facts.order is None:
        return clause.skipped("the order in the files is not known")
    steps = [facts.order.steps_back(key) for key in facts.connections.get(topic.name, ())]
    count = sum(step.count for step in steps)
    worst = max((step.worst for step in steps if step.worst), key=lambda step: step.size, default=None)
    first = next((step.first for step in steps if step.first), None)
    total = 0 if topic.monitor is None else topic.monitor.read
    where = None if worst is None else occurrence(worst.log_time_ns, None, worst.size)
    begin = None if first is None else occurrence(first.log_time_ns, None, first.size)
    what = "messages have an earlier log time than the message before them"
    back = f", the largest step back is {duration_text(worst.size)}" if worst else ""
    return limit_result(clause, clause.expected.max, count, total, what + back, first=begin, worst=where)


def _header(clause: Clause, topic: TopicFacts, facts: Facts) -> ExpectationResult:
    monitor = topic.monitor
    if clause.key == "sequence_numbers" and facts.order is not None:
        keys = facts.connections.get(topic.name, ())
        gaps = [gap for key in keys if (gap := facts.order.missing_numbers(key)) is not None]
        if gaps:
            missing = sum(gap.total for gap in gaps)
            worst = max((gap.worst for gap in gaps if gap.worst), key=lambda step: step.size, default=None)
            first = next((gap.first for gap in gaps if gap.first), None)
            message_count = 0 if monitor is None else monitor.read
            return limit_result(
                clause,
                clause.expected.missing,
                missing,
                missing + message_count,
                "sequence numbers are missing",
                first=None if first is None else occurrence(first.log_time_ns, None, first.size),
                worst=None if worst is None else occurrence(worst.log_time_ns, None, worst.size),
            )
    rows = [] if monitor is None else list(monitor.rows.values())
    return header_result(clause, rows, topic.msgtypes[0] if topic.msgtypes else "")


def _time_result(clause: Clause, monitor: TopicMonitor, facts: Facts) -> ExpectationResult:
    times, key = monitor.times, clause.key
    if times.late and key in {"sliding_rate", "gap", "gaps", "coverage"}:
        return clause.skipped("the messages are too far out of order")
    if times.count < 2 and key in {"sliding_rate", "gap", "gaps"}:  # noqa: PLR2004 - an interval has two ends
        return _too_few(clause, times.count)
    return _TIME_RESULTS[key](clause, monitor, facts)


def _too_few(clause: Clause, count: int) -> ExpectationResult:
    low = getattr(clause.expected, "min", None)
    if low is not None:
        return clause.failed(f"the topic has {counted(count, 'message')}, which have no rate", measured=None)
    return clause.skipped(f"the topic has {counted(count, 'message')}")


def _rate(clause: Clause, monitor: TopicMonitor, facts: Facts) -> ExpectationResult:
    times, expected = monitor.times, clause.expected
    limit = bounds_text(
        *(None if hz is None else f"{number_text(hz)} Hz" for hz in (expected.min, expected.max))
    )
    if times.count < 2 or times.first_ns is None or times.last_ns is None:  # noqa: PLR2004 - a rate needs an interval
        return _too_few(clause, times.count)
    rate = mean_rate_hz(times.count, times.first_ns, times.last_ns)
    if rate is None:
        return clause.failed(f"all of {counted(times.count, 'message')} have one log time", limit=limit)
    if _within(rate, expected.min, expected.max):
        text = f"the mean rate is {number_text(rate)} Hz; expected {limit}"
        return clause.passed(text, measured=rate, unit="Hz", limit=limit)
    paused = covered_ns(times.first_ns, times.last_ns, facts.events.windows_of(monitor.name))
    active_rate = mean_rate_hz(times.count, times.first_ns, times.last_ns - paused)
    if paused and active_rate is not None:
        rate = active_rate
        note = f" without {duration_text(paused)} in which the recorder was paused"
    else:
        note = ""
    is_good = _within(rate, expected.min, expected.max)
    text = f"the mean rate is {number_text(rate)} Hz{note}; expected {limit}"
    return _result(clause, is_good, text, measured=rate, unit="Hz", limit=limit, explained=int(is_good))


def _sliding_rate(clause: Clause, monitor: TopicMonitor, facts: Facts) -> ExpectationResult:  # noqa: ARG001 - the signature of all
    window, expected = monitor.times.windows[clause.key], clause.expected
    seconds = expected.window / 1e9
    limit = bounds_text(
        *(None if hz is None else f"{number_text(hz)} Hz" for hz in (expected.min, expected.max))
    )
    if window.lowest is None or window.highest is None:
        span = duration_text(monitor.times.span_ns)
        return clause.skipped(
            f"the topic lasts {span}, less than a window of {duration_text(expected.window)}"
        )
    low, high = window.lowest.count / seconds, window.highest.count / seconds
    too_low = expected.min is not None and low < expected.min - 1e-9 / seconds
    too_high = expected.max is not None and high > expected.max + 1e-9 / seconds
    text = (
        f"the rate in windows of {duration_text(expected.window)} is from {number_text(low)} Hz to "
        f"{number_text(high)} Hz; expected {limit}"
    )
    extreme = window.lowest if too_low else window.highest
    measured = low if too_low else high
    details: dict[str, Any] = {"measured": measured, "unit": "Hz", "limit": limit}
    if not (too_low or too_high):
        return clause.passed(text, **details)
    worst = occurrence(extreme.start_ns, extreme.index, measured)
    first = None
    if window.first is not None:
        first = occurrence(window.first.start_ns, window.first.index, window.first.count / seconds)
    text += extremes_text(first, worst)
    return clause.failed(text, violations=window.violations, first=first, worst=worst, **details)


def _unexplained(gaps: Gaps, name: str, facts: Facts, limit_ns: int) -> tuple[np.ndarray[Any, Any], Windows]:
    """Return which long intervals the recorder's events do not explain, and the windows of the events."""
    windows = facts.events.windows_of(name) if len(gaps.lengths) else RecorderEvents().paused
    if not len(windows):
        return np.ones(len(gaps.lengths), bool), windows
    return uncovered_ns(gaps.ends - gaps.lengths, gaps.ends, windows) > limit_ns, windows


def _gap(clause: Clause, monitor: TopicMonitor, facts: Facts) -> ExpectationResult:
    gaps, longest = monitor.times.gaps[clause.key], monitor.times.longest
    limit_ns = clause.expected.max
    limit = f"at most {duration_text(limit_ns)}"
    unexplained, _ = _unexplained(gaps, monitor.name, facts, limit_ns)
    explained = len(unexplained) - int(unexplained.sum())
    if not unexplained.any():
        if explained:
            text = f"{counted(explained, 'gap')} longer than {duration_text(limit_ns)}, while the recorder was paused"
            return clause.passed(
                text, measured=int(gaps.lengths.max()), unit="ns", limit=limit, explained=explained
            )
        length = 0 if longest is None else longest.length_ns
        text = f"the longest gap is {duration_text(length)}; expected {limit}"
        return clause.passed(text, measured=length, unit="ns", limit=limit)
    positions = np.flatnonzero(unexplained)
    first = gaps.at(int(positions[0]))
    worst = gaps.at(int(positions[int(gaps.lengths[positions].argmax())]))
    where = occurrence(worst.end_ns, worst.index, worst.length_ns)
    begin = occurrence(first.end_ns, first.index, first.length_ns)
    many = f" ({count_text(len(positions))} gaps are longer)" if len(positions) > 1 else ""
    text = f"the longest gap is {duration_text(worst.length_ns)}; expected {limit}{many}{extremes_text(begin, where)}"
    return clause.failed(
        text,
        measured=worst.length_ns,
        unit="ns",
        limit=limit,
        violations=len(positions),
        first=begin,
        worst=where,
        explained=explained,
    )


def _gap_share(clause: Clause, monitor: TopicMonitor, facts: Facts) -> ExpectationResult:
    gaps, expected = monitor.times.gaps[clause.key], clause.expected
    limit_ns = gaps.limit_ns or 0
    limit = f"at most {share_text(expected.max_share)}"
    unexplained, _ = _unexplained(gaps, monitor.name, facts, limit_ns)
    positions = np.flatnonzero(unexplained)
    share = len(positions) / gaps.total
    text = (
        f"{count_text(len(positions))} of {count_text(gaps.total)} intervals ({share_text(share)}) are longer than "
        f"{duration_text(limit_ns)}; expected {limit}"
    )
    details: dict[str, Any] = {"measured": share, "unit": "share", "limit": limit}
    details["explained"] = len(unexplained) - len(positions)
    if share <= expected.max_share:
        return clause.passed(text, **details)
    first = gaps.at(int(positions[0]))
    worst = gaps.at(int(positions[int(gaps.lengths[positions].argmax())]))
    begin = occurrence(first.end_ns, first.index, first.length_ns)
    where = occurrence(worst.end_ns, worst.index, worst.length_ns)
    text += f"; the longest is {duration_text(worst.length_ns)}{extremes_text(begin, where)}"
    return clause.failed(text, violations=len(positions), first=begin, worst=where, **details)


def _coverage(clause: Clause, monitor: TopicMonitor, facts: Facts) -> ExpectationResult:
    times, expected = monitor.times, clause.expected
    subject = "the recording" if expected.of == RECORDING else expected.of
    span = facts.span_of(expected.of)
    limit = f"at least {share_text(expected.min)}"
    if span is None:
        return clause.failed(f"{subject} has no message, so its coverage is unknown", limit=limit)
    start, end = span
    gaps = times.gaps[clause.key]
    if times.first_ns is None or times.last_ns is None:
        text = f"the topic has no message, so it covers 0% of {subject}; expected {limit}"
        return clause.failed(text, measured=0.0, unit="share", limit=limit)
    limit_ns = gaps.limit_ns if gaps.limit_ns is not None else 0
    # The time before the first and after the last message counts like the time between messages.
    starts = np.concatenate([[start], gaps.ends - gaps.lengths, [times.last_ns]])
    ends = np.concatenate([[times.first_ns], gaps.ends, [end]])
    starts, ends = np.maximum(starts, start), np.minimum(ends, end)
    lengths = np.maximum(ends - starts, 0)
    windows = facts.events.windows_of(monitor.name) if (lengths > limit_ns).any() else RecorderEvents().paused
    rest = uncovered_ns(starts, ends, windows) if len(windows) else lengths
    missing = (lengths > limit_ns) & (rest > limit_ns)
    explained = int(((lengths > limit_ns) & ~missing).sum())
    total = end - start
    share = 1.0 if not total else 1 - int(lengths[missing].sum()) / total
    text = f"the topic covers {share_text(share)} of {subject}; expected {limit}"
    details: dict[str, Any] = {"measured": share, "unit": "share", "limit": limit, "explained": explained}
    if share >= expected.min:
        return clause.passed(text, **details)
    positions = np.flatnonzero(missing)
    most = int(positions[int(lengths[positions].argmax())])
    first = occurrence(int(ends[positions[0]]), None, int(lengths[positions[0]]))
    worst = occurrence(int(ends[most]), None, int(lengths[most]))
    text += (
        f"; the longest interval without messages is {duration_text(int(lengths[most]))}, "
        f"until {instant_text(int(ends[most]))}"
    )
    return clause.failed(text, violations=len(positions), first=first, worst=worst, **details)


def _proximity(clause: Clause, monitor: TopicMonitor, facts: Facts) -> ExpectationResult:
    expected, key = clause.expected, clause.key
    subject = "the recording" if expected.of == RECORDING else expected.of
    span, times = facts.span_of(expected.of), monitor.times
    limit = f"at most {duration_text(expected.within)}"
    if span is None:
        return clause.failed(f"{subject} has no message to compare the {key} with", limit=limit)
    if times.first_ns is None or times.last_ns is None:
        return clause.failed(f"the topic has no message, so it has no {key}", limit=limit)
    own, other = (times.first_ns, span[0]) if key == "start" else (times.last_ns, span[1])
    distance = own - other
    side = "after" if distance >= 0 else "before"
    verb = "starts" if key == "start" else "ends"
    text = f"the topic {verb} {duration_text(abs(distance))} {side} the {key} of {subject}; expected {limit}"
    details: dict[str, Any] = {"measured": distance, "unit": "ns", "limit": limit}
    if abs(distance) <= expected.within:
        return clause.passed(text, **details)
    windows = facts.events.windows_of(monitor.name)
    first, last = min(own, other), max(own, other)
    if len(windows) and last - first - covered_ns(first, last, windows) <= expected.within:
        return clause.passed(f"{text}; the recorder was paused", explained=1, **details)
    index = 0 if key == "start" else times.count - 1
    return clause.failed(text, worst=occurrence(own, index, distance), **details)


_TIME_RESULTS: Mapping[str, Callable[[Clause, TopicMonitor, Facts], ExpectationResult]] = {
    "rate": _rate,
    "sliding_rate": _sliding_rate,
    "gap": _gap,
    "gaps": _gap_share,
    "coverage": _coverage,
    "start": _proximity,
    "end": _proximity,
}
"""The functions that evaluate expectations of log times, by key."""


def _within(value: float, low: float | None, high: float | None) -> bool:
    return (low is None or value >= low) and (high is None or value <= high)


def _or_none(text: Callable[[Any], str], value: Any) -> str | None:  # noqa: ANN401 - the argument of `text`
    return None if value is None else text(value)


def _result(clause: Clause, is_good: bool, text: str, **details: Any) -> ExpectationResult:  # noqa: FBT001, ANN401 - as computed
    if is_good:
        details.pop("first", None)
        details.pop("worst", None)
        return clause.passed(text, **details)
    return clause.failed(text + extremes_text(details.get("first"), details.get("worst")), **details)


class Member(Struct, frozen=True):
    """A recording of a group; the times are None if it has no message or cannot be opened."""

    names: tuple[str, ...]
    """The names of its files, and of its folder if it is one."""
    start_ns: int | None = None
    end_ns: int | None = None


def group_results(contract: Contract, members: Sequence[Member]) -> tuple[ExpectationResult, ...]:
    """Return the results of `expect.group` for the recordings of one group."""
    return tuple(_group_result(clause, members) for clause in contract.group_clauses())


def _group_result(clause: Clause, members: Sequence[Member]) -> ExpectationResult:
    if clause.key in {"starts", "ends"}:
        return _group_distance(clause, members)
    return _group_gap(clause, members) if clause.key == "gap" else _group_file(clause, members)


def _group_file(clause: Clause, members: Sequence[Member]) -> ExpectationResult:
    pattern = clause.expected
    names = [name for member in members for name in member.names]
    count = sum(any(fnmatchcase(name, pattern) for name in member.names) for member in members)
    if count:
        text = f"{pattern!r} matches {counted(count, 'recording')}"
        return clause.passed(text, measured=count, unit="recordings", limit="at least 1 recording")
    near = get_close_matches(pattern, names, n=1, cutoff=0.4)
    nearest = f"; the nearest is {near[0]}" if near else ""
    text = f"no file for {pattern!r} among {counted(len(members), 'recording')}{nearest}"
    return clause.failed(text, measured=0, unit="recordings", limit="at least 1 recording")


def _group_distance(clause: Clause, members: Sequence[Member]) -> ExpectationResult:
    times = [
        (time, member.names[0])
        for member in members
        if (time := member.start_ns if clause.key == "starts" else member.end_ns) is not None
    ]
    absent = [member.names[0] for member in members if member.start_ns is None]
    limit = f"at most {duration_text(clause.expected.within)}"
    if absent:
        return clause.failed(f"{absent[0]} has no message, so it has no start and no end", limit=limit)
    if not times:
        return clause.skipped("the group has no recording")
    (first, early), (last, late) = min(times), max(times)
    distance = last - first
    verb = "starts" if clause.key == "starts" else "ends"
    text = f"{late} {verb} {duration_text(distance)} after {early}; expected {limit}"
    if distance <= clause.expected.within:
        return clause.passed(text, measured=distance, unit="ns", limit=limit)
    return clause.failed(
        text, measured=distance, unit="ns", limit=limit, worst=occurrence(last, None, distance)
    )


def _group_gap(clause: Clause, members: Sequence[Member]) -> ExpectationResult:
    spans = sorted(
        (member.start_ns, member.end_ns, member.names[0])
        for member in members
        if member.start_ns is not None and member.end_ns is not None
    )
    limit = f"at most {duration_text(clause.expected.max)}"
    if len(spans) < 2:  # noqa: PLR2004 - an interval lies between two recordings
        return clause.skipped(f"the group has {counted(len(spans), 'recording')} with messages")
    longest, before, after, end = 0, "", "", spans[0][1]
    bad = 0
    previous = spans[0][2]
    for start, stop, name in spans[1:]:
        gap = start - end
        bad += gap > clause.expected.max
        if gap > longest:
            longest, before, after = gap, previous, name
        if stop > end:
            end, previous = stop, name
    if not longest:
        return clause.passed(f"no interval is missing; expected {limit}", measured=0, unit="ns", limit=limit)
    text = f"{duration_text(longest)} are missing between {before} and {after}; expected {limit}"
    if not bad:
        return clause.passed(text, measured=longest, unit="ns", limit=limit)
    return clause.failed(text, measured=longest, unit="ns", limit=limit, violations=bad)
