"""Monitors: they observe the messages of a recording while it is read, for the expectations of its topics."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.mapping.columns import Array
from mosaico_ingest.contracts.clauses import Clause, Contract
from mosaico_ingest.contracts.expressions import (
    Evaluator,
    FieldExpression,
    Rows,
    Values,
    bind_expression,
    locator,
    type_findings,
)
from mosaico_ingest.contracts.order import FileOrder
from mosaico_ingest.contracts.times import Gaps, Int64s, SlidingWindow, TopicTimes
from mosaico_ingest.contracts.values import (
    Accumulator,
    AllowedTexts,
    AllowedValues,
    Batch,
    Changes,
    FiniteNumbers,
    LatencyRange,
    MissingNumbers,
    Moments,
    Nulls,
    NumberLimits,
    Steps,
    Unchanged,
    frames_of,
    header_numbers_of,
    ontology_stamps_of,
    stamps_of,
)
from mosaico_ingest.findings import Finding
from mosaico_ingest.job.values import RECORDING, Interval

TIME_KEYS = frozenset({"rate", "sliding_rate", "gap", "gaps", "messages", "coverage", "start", "end"})
"""Expectations of log times."""
STAMP_KEYS = frozenset({"latency", "stamps"})
HEADER_KEYS = STAMP_KEYS | {"frame_id", "sequence_numbers"}
"""Expectations that need the header of messages."""
ORDER_KEYS = frozenset({"out_of_order", "sequence_numbers"})
"""Expectations of the order of messages in the files."""


class FieldCheck(Struct, frozen=True):
    """One expectation of an expression, and its accumulator."""

    clause: Clause
    expression: FieldExpression
    accumulator: Accumulator


@dataclass(slots=True)
class RowMonitor:
    """Observes the rows of one connection, or of one stored topic."""

    clauses: Mapping[str, Clause]
    checks: tuple[FieldCheck, ...]
    latency: LatencyRange | None = None
    steps: dict[str, Steps] = field(default_factory=dict[str, Steps])
    """By `monotonic` and `unique`."""
    frames: AllowedTexts | None = None
    numbers: MissingNumbers | None = None
    has_header: bool = True
    """False if the rows have no header with a stamp and a frame."""

    def __post_init__(self) -> None:
        if "latency" in self.clauses:
            expected = self.clauses["latency"].expected
            self.latency = LatencyRange(expected.min, expected.max)
        if "stamps" in self.clauses:
            order = self.clauses["stamps"].expected.order
            self.steps = {
                name: Steps(name == "monotonic") for name in ((order,) if isinstance(order, str) else order)
            }
        if "frame_id" in self.clauses:
            self.frames = AllowedTexts(self.clauses["frame_id"].expected.one_of)
        if "sequence_numbers" in self.clauses:
            self.numbers = MissingNumbers()

    @property
    def needs_messages(self) -> bool:
        """Whether an expectation refers to fields of the message."""
        return bool(HEADER_KEYS & self.clauses.keys()) or any(
            not check.expression.is_ontology for check in self.checks
        )

    @property
    def needs_ontology(self) -> bool:
        """Whether an expectation refers to ontology columns, or to rejected messages."""
        return "rejected" in self.clauses or any(check.expression.is_ontology for check in self.checks)

    def add_messages(self, rows: Array, batch: Batch, envelope: Envelope) -> None:
        """Add decoded messages in the ROS shape."""
        if self.latency is not None or self.steps:
            self._add_stamps(stamps_of(rows), batch)
        if self.frames is not None and (frames := frames_of(rows)) is not None:
            self.frames.add(batch, frames)
        if self.numbers is not None and (numbers := header_numbers_of(rows)) is not None:
            self.numbers.add(batch, numbers)
        self.add_values(rows, batch, envelope)

    def add_values(self, rows: Array, batch: Batch, envelope: Envelope) -> None:
        """Add the values of messages in the ROS shape, without their headers."""
        self._add_values(rows, batch, envelope, is_ontology=False)

    def add_ontology(self, rows: Array, batch: Batch, envelope: Envelope) -> None:
        """Add ontology rows."""
        self._add_values(rows, batch, envelope, is_ontology=True)

    def add_stored(self, rows: Array, batch: Batch, envelope: Envelope) -> None:
        """Add rows of a stored topic, whose header is that of the ontology or of the ROS shape."""
        if self.latency is not None or self.steps:
            stored = ontology_stamps_of(rows)
            self._add_stamps(stamps_of(rows) if stored is None else stored, batch)
        if self.frames is not None and (frames := frames_of(rows)) is not None:
            self.frames.add(batch, frames)
        self._add_values(rows, batch, envelope, is_ontology=True)

    def finish(self) -> None:
        """Complete the accumulators after the last batch."""
        for check in self.checks:
            if isinstance(check.accumulator, Unchanged):
                check.accumulator.finish()

    def _add_stamps(self, stamps: NDArray[np.int64] | None, batch: Batch) -> None:
        if stamps is None:
            return
        if self.latency is not None:
            self.latency.add(batch, stamps)
        for steps in self.steps.values():
            steps.add(batch, stamps)

    def _add_values(self, rows: Array, batch: Batch, envelope: Envelope, *, is_ontology: bool) -> None:
        selected = [check for check in self.checks if check.expression.is_ontology is is_ontology]
        if not selected or not len(rows):
            return
        evaluator = Evaluator(rows, envelope)
        values: dict[str, Values] = {}
        for check in selected:
            text = check.expression.text
            if text not in values:
                values[text] = evaluator.values(check.expression)
            check.accumulator.add(batch, values[text])


@dataclass(slots=True)
class TopicMonitor:
    """Observes the messages of one topic."""

    name: str
    clauses: Mapping[str, Clause]
    times: TopicTimes
    rows: dict[int, RowMonitor] = field(default_factory=dict[int, RowMonitor])
    """By connection."""
    is_merged: bool = False
    """Whether the topic has several connections, whose log times are merged at the end."""
    read: int = 0
    rejected: int | None = None
    """Number of rejected messages; None if the messages were not converted."""
    _counts: dict[int, int] = field(default_factory=lambda: defaultdict[int, int](int))
    """Number of messages of each connection so far."""
    _times: list[Int64s] = field(default_factory=list[Int64s])

    def add_block(self, connection: int, log_times: Int64s) -> int:
        """Add the log times of a message block, which are sorted; return the position of its first message."""
        position = self._counts[connection]
        self._counts[connection] = position + len(log_times)
        self.read += len(log_times)
        if self.is_merged:
            self._times.append(log_times)
        else:
            self.times.add(log_times)
        return position

    def finish(self) -> None:
        """Complete the accumulators after the last block."""
        if self._times:
            self.times.add(np.sort(np.concatenate(self._times)))
            self._times = []
        self.times.finish()
        for rows in self.rows.values():
            rows.finish()

    def observer(
        self, connection: int, msgtype: str, *, start_ns: int | None = None, end_ns: int | None = None
    ) -> BlockObserver:
        """Return the observer of the message blocks of a connection, which ignores log times outside the range."""
        rows = self.rows.get(connection)
        return BlockObserver(self, connection, msgtype, rows, start_ns=start_ns, end_ns=end_ns)


@dataclass(slots=True)
class BlockObserver:
    """Passes the blocks of one connection to the monitors of its topic; called in this order for each block."""

    topic: TopicMonitor
    connection: int
    msgtype: str
    rows: RowMonitor | None
    start_ns: int | None = None
    """Start of the observed log times; None for all of them."""
    end_ns: int | None = None
    """End of the observed log times, exclusive."""
    _first: int = 0
    """Position on the topic of the first observed message of the current block."""
    _skipped: int = 0
    """Number of messages of the current block before the range."""
    _log_times: Int64s = field(default_factory=lambda: np.zeros(0, np.int64))
    """Log times of the observed messages of the current block."""

    def block(self, log_times: Int64s) -> None:
        """Start with a block of messages, whose log times are sorted."""
        start = 0 if self.start_ns is None else int(np.searchsorted(log_times, self.start_ns))
        end = None if self.end_ns is None else int(np.searchsorted(log_times, self.end_ns))
        self._skipped, self._log_times = start, log_times[start:end]
        self._first = self.topic.add_block(self.connection, self._log_times)

    def messages(self, rows: pa.StructArray, index: Int64s) -> None:
        """Add the decoded messages of the block; `index` is the position of each row in it."""
        if self.rows is not None and self.rows.needs_messages:
            self.rows.add_messages(*self._observed(rows, index))

    def ontology(self, rows: pa.StructArray, index: Int64s) -> None:
        """Add the ontology rows of the block; `index` is the position of each row in it."""
        if self.rows is not None and self.rows.needs_ontology:
            self.rows.add_ontology(*self._observed(rows, index))

    def _observed(self, rows: pa.StructArray, index: Int64s) -> tuple[pa.StructArray, Batch, Envelope]:
        """Return the rows inside the range, with their log times and positions on the topic."""
        positions = index - self._skipped
        inside = (positions >= 0) & (positions < len(self._log_times))
        if not inside.all():
            rows, positions = rows.filter(pa.array(inside)), positions[inside]
        times = self._log_times[positions]
        return rows, Batch(times, positions + self._first), Envelope(self.topic.name, self.msgtype, times)


def topic_monitor(contract: Contract, name: str, references: Iterable[str] = ()) -> TopicMonitor | None:
    """Return the monitor of a topic without rows; None if nothing about its messages is expected.

    `references` are the topics whose time span an expectation of another topic refers to.
    """
    clauses = contract.topic_clauses(name)
    has_fields = any(True for _ in contract.field_clauses(name))
    if not clauses and not has_fields and name not in references:
        return None
    times = TopicTimes()
    if "gap" in clauses:
        times.gaps["gap"] = Gaps(Interval(ns=clauses["gap"].expected.max))
    if "gaps" in clauses:
        times.gaps["gaps"] = Gaps(clauses["gaps"].expected.over)
    if "coverage" in clauses:
        times.gaps["coverage"] = Gaps(clauses["coverage"].expected.gap)
    if "sliding_rate" in clauses:
        expected = clauses["sliding_rate"].expected
        seconds = expected.window / 1e9
        times.windows["sliding_rate"] = SlidingWindow(
            expected.window,
            -np.inf if expected.min is None else expected.min * seconds - 1e-9,
            np.inf if expected.max is None else expected.max * seconds + 1e-9,
        )
    return TopicMonitor(name, clauses, times)


def referenced_topics(contract: Contract) -> frozenset[str]:
    """Return the topics that `of` names in any expectation."""
    entries = contract.expect.topics.values()
    proximities = (getattr(entry, key) for entry in entries for key in ("coverage", "start", "end"))
    return frozenset(item.of for item in proximities if item is not None and item.of != RECORDING)


def row_monitor(
    contract: Contract, topic: str, message: Rows | None, ontology: Rows | None, *, stored: bool = False
) -> tuple[RowMonitor | None, list[Finding]]:
    """Return the monitor of the rows of a topic and the mistakes of its expressions.

    The monitor is None if nothing about the rows is expected, or if an expression has a mistake.
    """
    clauses = contract.topic_clauses(topic)
    checks: list[FieldCheck] = []
    findings: list[Finding] = []
    for text, expected, of_field in contract.field_clauses(topic):
        path = of_field[0].path[:-1] if of_field else ()
        locate = locator(contract.job.span(*path) if path else None, text)
        expression, mistakes = bind_expression(text, message, ontology, locate)
        if expression is not None:
            mistakes = list(type_findings(expression, expected, locate))
        if mistakes or expression is None:
            findings += mistakes
            continue
        checks += [
            FieldCheck(clause, expression, _ACCUMULATORS[clause.key](clause.expected)) for clause in of_field
        ]
    wanted = clauses.keys() & (HEADER_KEYS | {"rejected"})
    if findings or not (checks or wanted):
        return None, findings
    shape = ontology if stored else message
    names = () if shape is None else tuple(member.name for member in shape.struct)
    return RowMonitor(clauses, tuple(checks), has_header="header" in names), []


def file_order(contract: Contract, topics: Iterable[str], *, is_mcap: bool) -> FileOrder | None:
    """Return the observer of the order in the files, or None if no topic needs it."""
    wanted = {key for topic in topics for key in contract.topic_clauses(topic)} & ORDER_KEYS
    if "out_of_order" in wanted or (is_mcap and wanted):
        return FileOrder(has_numbers=is_mcap)
    return None


_ACCUMULATORS: Mapping[str, Callable[[Any], Accumulator]] = {
    "between": lambda expected: NumberLimits(*expected),
    "min": lambda expected: NumberLimits(low=expected),
    "max": lambda expected: NumberLimits(high=expected),
    "finite": lambda _: FiniteNumbers(),
    "nulls": Nulls,
    "equals": lambda expected: AllowedValues((expected,)),
    "one_of": lambda expected: AllowedValues(tuple(expected)),
    "mean": lambda _: Moments(),
    "std": lambda _: Moments(),
    "change": lambda expected: Changes(
        -np.inf if expected.min is None else expected.min, np.inf if expected.max is None else expected.max
    ),
    "unchanged": lambda expected: Unchanged(expected.max),
}
"""The constructors of accumulators of values, by key of the expectation."""
