"""Monitors: they observe the messages of a recording while it is read, for the expectations of its topics."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from mosaico_ingest.contracts.clauses import ORDER_KEYS, ROW_KEYS, Clause, Contract
from mosaico_ingest.contracts.order import FileOrder
from mosaico_ingest.contracts.times import Gaps, Int64s, SlidingWindow, TopicTimes
from mosaico_ingest.contracts.values import Batch
from mosaico_ingest.job.values import RECORDING, Interval

if TYPE_CHECKING:
    from mosaico_ingest.adapters.adapter import Adapted
    from mosaico_ingest.contracts.row_monitor import RowMonitor


@dataclass(slots=True)
class TopicMonitor:
    """Observes the messages of one topic."""

    name: str
    clauses: Mapping[str, Clause]
    times: TopicTimes
    rows: dict[int, RowMonitor] = field(default_factory=dict)
    """By connection."""
    has_rows: bool = False
    """Whether an expectation refers to rows, not only to log times and the order in the files."""
    is_merged: bool = False
    """Whether the topic has several connections, whose log times are merged at the end."""
    read: int = 0
    rejected: int | None = None
    """Number of rejected messages; None if the messages were not converted."""
    _counts: dict[int, int] = field(default_factory=lambda: defaultdict[int, int](int))
    """Number of messages of each connection so far."""
    _times: list[Int64s] = field(default_factory=list[Int64s])

    @property
    def is_observed(self) -> bool:
        """Whether a block was observed, even if it has no message."""
        return bool(self._counts)

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


@dataclass(slots=True)
class BlockObserver:
    """Passes the blocks of one connection to the monitors of its topic; called in this order for each block."""

    topic: TopicMonitor
    connection: int
    rows: RowMonitor | None
    start_ns: int | None = None
    """Start of the observed log times; None for all of them."""
    end_ns: int | None = None
    """End of the observed log times, exclusive."""
    outputs: tuple[TopicMonitor | None, ...] = ()
    """The monitors of the outputs of the adapter, whose rows they observe like stored rows; None if nothing is expected."""
    _first: int = 0
    """Position on the topic of the first observed message of the current block."""
    _skipped: int = 0
    """Number of messages of the current block before the range."""
    _log_times: Int64s = field(default_factory=lambda: np.zeros(0, np.int64))
    """Log times of the observed messages of the current block."""

    @property
    def needs_rows(self) -> bool:
        """Whether log times are not enough."""
        return self.rows is not None or bool(self.outputs)

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

    def adapted(self, adapted: Adapted, index: Int64s) -> None:
        """Add the ontology rows of the block; `index` is the position in it of each message that was adapted."""
        if self.rows is not None and self.rows.needs_ontology and not self.outputs:
            self.rows.add_ontology(*self._observed(adapted.rows, index[adapted.index]))
        if self.outputs:
            for monitor, output in zip(self.outputs, (adapted, *adapted.others), strict=True):
                if monitor is not None:
                    self._add_output(monitor, *self._observed(output.rows, index[output.index]))

    def _add_output(self, monitor: TopicMonitor, rows: pa.StructArray, messages: Batch) -> None:
        first = monitor.add_block(self.connection, messages.log_times)
        of_rows = monitor.rows.get(self.connection)
        if of_rows is not None:
            positions = np.arange(first, first + len(rows), dtype=np.int64)
            of_rows.add_stored(rows, Batch(messages.log_times, positions))

    def _observed(self, rows: pa.StructArray, index: Int64s) -> tuple[pa.StructArray, Batch]:
        """Return the rows inside the range, with their log times and positions on the topic."""
        positions = index - self._skipped
        inside = (positions >= 0) & (positions < len(self._log_times))
        if not inside.all():
            rows, positions = rows.filter(pa.array(inside)), positions[inside]
        times = self._log_times[positions]
        return rows, Batch(times, positions + self._first)


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
    has_rows = has_fields or bool(clauses.keys() & ROW_KEYS)
    return TopicMonitor(name, clauses, times, has_rows=has_rows)


def referenced_topics(contract: Contract) -> frozenset[str]:
    """Return the topics that `of` names in any expectation."""
    entries = contract.expect.topics.values()
    proximities = (getattr(entry, key) for entry in entries for key in ("coverage", "start", "end"))
    return frozenset(item.of for item in proximities if item is not None and item.of != RECORDING)


def file_order(contract: Contract, topics: Iterable[str], *, is_mcap: bool) -> FileOrder | None:
    """Return the observer of the order in the files, or None if no topic needs it."""
    keys = {key for topic in topics for key in contract.topic_clauses(topic)} & ORDER_KEYS
    if "out_of_order" in keys or (is_mcap and keys):
        return FileOrder(has_numbers=is_mcap)
    return None
