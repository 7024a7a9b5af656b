"""Data contracts: evaluates the section `expect` of a job.

The input is a plan's topics and the columns of their messages, batch by batch; the output is a `ContractResult`
(`report.parts`). The package must not depend on pipelines, executors or the command line. This module has the clauses of a
contract: each expectation of a job with its key path, severity and location, and the texts of results.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from fnmatch import fnmatchcase
from math import isfinite
from typing import TYPE_CHECKING, Any

from msgspec import Struct

from mosaico_ingest.display import count_text
from mosaico_ingest.findings import Severity, Span, one_line
from mosaico_ingest.job.expect import (
    AllowedNames,
    Expectation,
    Expectations,
    ExpectedTopic,
    FieldExpectations,
    StampOrder,
    TopicExpectations,
)
from mosaico_ingest.job.expect import (
    Limit as LimitExpectation,
)
from mosaico_ingest.job.model import Job
from mosaico_ingest.job.values import Limit, TimeBound, format_time
from mosaico_ingest.report.parts import ExpectationResult, Location, Occurrence, Outcome
from mosaico_ingest.rosbag.definitions.model import normalize_msgtype

if TYPE_CHECKING:
    from mosaico_ingest.ontology.registry import OntologyType

KeyPath = tuple[str | int, ...]
TIME_KEYS = frozenset({"rate", "sliding_rate", "gap", "gaps", "messages", "coverage", "start", "end"})
"""Expectations of log times."""
HEADER_KEYS = frozenset({"latency", "stamps", "frame_id", "sequence_numbers"})
"""Expectations that need the header of messages."""
ROW_KEYS = HEADER_KEYS | {"rejected"}
"""Expectations of a topic, except `fields`, that need decoded messages."""
ORDER_KEYS = frozenset({"out_of_order", "sequence_numbers"})
"""Expectations of the order of messages in the files."""

_LISTS = {"type": AllowedNames, "frame_id": AllowedNames}
_LIMITS = frozenset({"rejected", "out_of_order", "unreadable"})


_UNITS = (
    (3_600_000_000_000, "h"),
    (60_000_000_000, "min"),
    (1_000_000_000, "s"),
    (1_000_000, "ms"),
    (1_000, "us"),
)
_SHORT_NS = 120_000_000_000
"""Durations below two minutes are shown in seconds or smaller units."""


class ReadTopic(Struct, frozen=True):
    """A topic that is read: its connections, and the type of its rows."""

    topic: str
    """The name in the recording."""
    connections: tuple[int, ...]
    ontology: OntologyType | None = None
    """The type of its rows; None if no expectation refers to them, and for an adapter with `outputs`."""
    outputs: tuple[tuple[str, OntologyType], ...] = ()
    """The name and the type of each output of an adapter with `outputs`, in the order of the adapter's rows."""


class Clause(Struct, frozen=True):
    """One expectation of the recording, of one of its topics, or of an expression."""

    path: KeyPath
    expected: Any
    """The expectation; short forms are replaced by the mapping that they stand for."""
    severity: Severity
    topic: str | None = None
    span: Span | None = None
    own: int = 1
    """Position in `path` of the first key below the recording, the topic or the group."""

    @property
    def key(self) -> str:
        """The last key of the path."""
        return str(self.path[-1])

    def passed(self, text: str, **details: Any) -> ExpectationResult:  # noqa: ANN401 - fields of the result
        """Return the result of an expectation that holds."""
        return self._result(Outcome.PASSED, text, details)

    def failed(self, text: str, **details: Any) -> ExpectationResult:  # noqa: ANN401 - fields of the result
        """Return the result of an expectation that does not hold."""
        details.setdefault("violations", 1)
        return self._result(Outcome.FAILED, text, details)

    def skipped(self, reason: str) -> ExpectationResult:
        """Return the result of an expectation that cannot be evaluated."""
        return self._result(Outcome.SKIPPED, f"{self.key} not evaluated: {reason}", {})

    def _result(self, outcome: Outcome, text: str, details: dict[str, Any]) -> ExpectationResult:
        span = self.span
        return ExpectationResult(
            expectation=".".join(map(str, self.path)),
            key=".".join(map(str, self.path[self.own :])),
            severity=self.severity,
            outcome=outcome,
            text=one_line(text),
            topic=self.topic,
            location=None if span is None else Location.of(span),
            **details,
        )


class Contract(Struct, frozen=True):
    """The section `expect` of a job."""

    job: Job
    expect: Expectations
    group: tuple[ExpectationResult, ...] = ()
    """The results of the expectations of the group that the recording belongs to."""
    _of_topics: dict[str, dict[str, Clause]] = {}
    """The results of `topic_clauses`, by topic."""

    @classmethod
    def of(cls, job: Job, group: tuple[ExpectationResult, ...] = ()) -> Contract | None:
        """Return the contract of a job, or None."""
        return None if job.expect is None else cls(job, job.expect, group)

    def recording_clauses(self) -> Iterator[Clause]:
        """Yield the expectations of the recording."""
        section = self.expect.recording
        if section is None:
            return
        for name in type(section).model_fields:
            value = getattr(section, name)
            if name != "severity" and value is not None:
                yield self._clause(("expect", "recording", name), value, section.severity)

    def pattern_clauses(self, key: str) -> Iterator[tuple[str, Clause]]:
        """Yield the patterns of `required` or `forbidden`, each with its clause."""
        for position, item in enumerate(getattr(self.expect, key)):
            pattern = item.topic if isinstance(item, ExpectedTopic) else item
            severity = item.severity if isinstance(item, ExpectedTopic) else None
            yield pattern, self._clause(("expect", key, position), item, severity)

    def lists(self, topic: str) -> bool:
        """Return whether a pattern of `required` or `forbidden` matches a topic."""
        patterns = [pattern for key in ("required", "forbidden") for pattern, _ in self.pattern_clauses(key)]
        return any(fnmatchcase(topic, pattern) for pattern in patterns)

    def topic_clauses(self, topic: str) -> Mapping[str, Clause]:
        """Return the expectations that apply to a topic by key, without those of `fields`."""
        if topic not in self._of_topics:
            self._of_topics[topic] = self._topic_clauses(topic)
        return self._of_topics[topic]

    def field_clauses(self, topic: str) -> Iterator[tuple[str, FieldExpectations, list[Clause]]]:
        """Yield the expressions that apply to a topic, each with its expectations."""
        for expression, glob in self.expect.fields_of(topic).items():
            entry = self.expect.topics[glob]
            expected = entry.fields[expression]
            path = ("expect", "topics", glob, "fields", expression)
            clauses = [
                self._clause(
                    (*path, name), getattr(expected, name), expected.severity or entry.severity, topic
                )
                for name in FieldExpectations.model_fields
                if name != "severity" and getattr(expected, name) not in (None, False)
            ]
            yield expression, expected, clauses

    def group_clauses(self) -> Iterator[Clause]:
        """Yield the expectations of several recordings."""
        section = self.expect.group
        if section is None:
            return
        for position, pattern in enumerate(section.files):
            yield self._clause(("expect", "group", "files", position), pattern, section.severity)
        for name in ("starts", "ends", "gap"):
            value = getattr(section, name)
            if value is not None:
                yield self._clause(("expect", "group", name), value, section.severity)

    def _topic_clauses(self, topic: str) -> dict[str, Clause]:
        clauses: dict[str, Clause] = {}
        for name in TopicExpectations.model_fields:
            glob = None if name in {"severity", "fields"} else self.expect.entry_of(topic, name)
            if glob is None:
                continue
            entry = self.expect.topics[glob]
            value = getattr(entry, name)
            if value is not None:
                path = ("expect", "topics", glob, name)
                clauses[name] = self._clause(path, value, entry.severity, topic)
        return clauses

    def _clause(
        self,
        path: KeyPath,
        value: Any,  # noqa: ANN401 - any form of an expectation
        severity: str | None,
        topic: str | None = None,
    ) -> Clause:
        expected = _full_form(str(path[-1]), value)
        own = expected.severity if isinstance(expected, Expectation) else None
        span = self.job.span(*path)
        first = {"recording": 2, "topics": 3, "group": 2}.get(str(path[1]), 1)
        return Clause(
            path, expected, Severity(own or severity or self.expect.severity), topic, span, own=first
        )


def _full_form(key: str, value: Any) -> Any:  # noqa: ANN401 - any form of an expectation
    """Return the mapping that a short form stands for, and any other value unchanged."""
    if isinstance(value, Expectation):
        return value
    if key in _LIMITS:
        return LimitExpectation(max=value)
    if key in _LISTS:
        return AllowedNames(one_of=(value,) if isinstance(value, str) else tuple(value))
    if key == "stamps":
        return StampOrder(order=value)
    return value


def other_types(expected: AllowedNames, msgtypes: Iterable[str]) -> list[str]:
    """Return the message types that an expectation does not allow; `pkg/Name` of ROS 1 is `pkg/msg/Name`."""
    allowed = set(map(normalize_msgtype, expected.one_of))
    return [name for name in msgtypes if normalize_msgtype(name) not in allowed]


def occurrence(
    log_time_ns: int | None = None,
    index: int | None = None,
    value: Any = None,  # noqa: ANN401 - any value
) -> Occurrence:
    """Return an occurrence; numbers that JSON cannot represent become texts."""
    if isinstance(value, float) and value - value != 0:
        value = repr(value)
    return Occurrence(log_time_ns=log_time_ns, index=index, value=value)


def duration_text(ns: float) -> str:
    """Return a duration in a suitable unit, such as `50 ms` or `1.5 h`."""
    size = abs(ns)
    if size < _SHORT_NS:
        unit, name = next(((unit, name) for unit, name in _UNITS[2:] if size >= unit), (1, "ns"))
    else:
        unit, name = next((unit, name) for unit, name in _UNITS if size >= unit)
    return f"{number_text(ns / unit)} {name}"


def number_text(value: float) -> str:
    """Return a number with at most six significant digits and thousands separators for whole numbers."""
    if isfinite(value) and abs(value) < 1e15 and value == int(value):  # noqa: PLR2004 - exact
        return count_text(int(value))
    return f"{value:.6g}"


def share_text(value: float) -> str:
    """Return a share as a percentage, such as `0.15%`."""
    return f"{100 * value:.4g}%"


def instant_text(ns: int) -> str:
    """Return an instant in ISO 8601."""
    try:
        return format_time(TimeBound(ns))
    except (OverflowError, ValueError, OSError):
        return f"{ns} ns"


def part_text(limit: Limit, count: int, total: int, what: str) -> str:
    """Return the part of a total that a limit applies to, such as `3 of 20 messages were rejected (15%)`."""
    percentage = f" ({share_text(count / total)})" if limit.count is None and total else ""
    return f"{count_text(count)} of {count_text(total)} {what}{percentage}"


def limit_text(limit: Limit) -> str:
    """Return a maximum number or share of messages."""
    return (
        f"at most {count_text(limit.count)}"
        if limit.count is not None
        else f"at most {share_text(limit.share or 0)}"
    )


def bounds_text(low: str | None, high: str | None) -> str:
    """Return a range such as `from 95 Hz to 105 Hz`, `at least 95 Hz` or `at most 105 Hz`."""
    if low is not None and high is not None:
        return f"from {low} to {high}"
    return f"at least {low}" if low is not None else f"at most {high}"


def position_text(where: Occurrence) -> str:
    """Return the position of an occurrence, such as `2026-01-01T00:00:04.1Z (message 410)`."""
    time = "" if where.log_time_ns is None else instant_text(where.log_time_ns)
    index = "" if where.index is None else f"message {count_text(where.index)}"
    return f"{time} ({index})" if time and index else time or index


def extremes_text(first: Occurrence | None, worst: Occurrence | None) -> str:
    """Return where the first and the worst violation are, to be appended to a text."""
    if worst is None or (worst.log_time_ns is None and worst.index is None):
        return ""
    if first is None or (first.log_time_ns, first.index) == (worst.log_time_ns, worst.index):
        return f"; at {position_text(worst)}"
    return f"; first at {position_text(first)}, worst at {position_text(worst)}"


def value_text(data: Any) -> str:  # noqa: ANN401 - any value of an occurrence
    """Return a value of a message."""
    if data is None:
        return "null"
    if isinstance(data, bool):
        return "true" if data else "false"
    return number_text(data) if isinstance(data, int | float) else repr(data)
