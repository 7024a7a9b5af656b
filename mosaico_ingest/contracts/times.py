"""Streaming accumulators over the log times of one topic.

Times arrive in batches, in order. Every accumulator carries the state across batches that makes its result independent
of the size of the batches.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.job.values import Interval

Int64s = NDArray[np.int64]
PERIOD_SAMPLE = 1000
"""Number of first intervals whose median is a topic's period."""
_NONE = np.zeros(0, np.int64)


class Gap(Struct, frozen=True):
    """An interval between two consecutive messages."""

    start_ns: int
    end_ns: int
    index: int
    """Position on the topic of the message that ends the interval."""

    @property
    def length_ns(self) -> int:
        """The length in nanoseconds."""
        return self.end_ns - self.start_ns


@dataclass(slots=True)
class Gaps:
    """The intervals that are longer than a limit."""

    over: Interval
    lengths: Int64s = field(default_factory=lambda: _NONE)
    """Length of each long interval in nanoseconds, shape (n,)."""
    ends: Int64s = field(default_factory=lambda: _NONE)
    """Log time of the message that ends each long interval, shape (n,)."""
    indexes: Int64s = field(default_factory=lambda: _NONE)
    """Position on the topic of the message that ends each long interval, shape (n,)."""
    total: int = 0
    """Number of intervals."""
    limit_ns: int | None = None
    """The limit in nanoseconds; None while a multiple of the period is unknown."""
    _pending: list[tuple[Int64s, Int64s, int]] = field(default_factory=list[tuple[Int64s, Int64s, int]])
    """Intervals, end times and first index of the batches before the period is known."""
    _found: list[tuple[Int64s, Int64s, Int64s]] = field(default_factory=list[tuple[Int64s, Int64s, Int64s]])

    def __post_init__(self) -> None:
        self.limit_ns = self.over.ns

    def add(self, intervals: Int64s, ends: Int64s, index: int) -> None:
        """Add intervals; `index` is the position of the message that ends the first one."""
        self.total += len(intervals)
        if self.limit_ns is None:
            self._pending.append((intervals, ends, index))
            if self.total >= PERIOD_SAMPLE:
                self._resolve()
        else:
            self._select(intervals, ends, index)

    def finish(self) -> None:
        """Complete the arrays after the last batch."""
        if self.limit_ns is None and self.total:
            self._resolve()
        if self._found:
            lengths, ends, indexes = zip(*self._found, strict=True)
            self.lengths, self.ends, self.indexes = map(np.concatenate, (lengths, ends, indexes))
            self._found = []

    def at(self, position: int) -> Gap:
        """Return one of the long intervals."""
        end = int(self.ends[position])
        return Gap(end - int(self.lengths[position]), end, int(self.indexes[position]))

    def _resolve(self) -> None:
        sample = np.concatenate([intervals for intervals, _, _ in self._pending])[:PERIOD_SAMPLE]
        self.limit_ns = int((self.over.periods or 0) * float(np.median(sample)))
        pending, self._pending = self._pending, []
        for intervals, ends, index in pending:
            self._select(intervals, ends, index)

    def _select(self, intervals: Int64s, ends: Int64s, index: int) -> None:
        positions = np.flatnonzero(intervals > (self.limit_ns or 0))
        if len(positions):
            self._found.append((intervals[positions], ends[positions], positions + index))


class WindowExtreme(Struct, frozen=True):
    """The window with the lowest or highest count."""

    count: int
    start_ns: int
    index: int
    """Position on the topic of the message at which the window starts."""


@dataclass(slots=True)
class SlidingWindow:
    """The lowest and the highest number of messages in windows of one length.

    For the highest number, a window starts with a message; for the lowest number, it starts right after a message and
    ends within the topic's time span. The count of a periodic topic is the same in both.
    """

    length_ns: int
    min_count: float = -np.inf
    """Windows with fewer messages are violations."""
    max_count: float = np.inf
    """Windows with more messages are violations."""
    lowest: WindowExtreme | None = None
    highest: WindowExtreme | None = None
    violations: int = 0
    first: WindowExtreme | None = None
    _times: Int64s = field(default_factory=lambda: _NONE)
    """Log times from the first message whose window may not be complete."""
    _index: int = 0
    """Position on the topic of the first of `_times`."""

    def add(self, times: Int64s) -> None:
        """Add log times in order."""
        self._times = np.concatenate([self._times, times])
        complete = int(np.searchsorted(self._times, self._times[-1] - self.length_ns, "left"))
        if complete:
            self._count(complete, complete)

    def finish(self) -> None:
        """Count the windows of the last messages."""
        if len(self._times):
            inside = int(np.searchsorted(self._times, self._times[-1] - self.length_ns, "right"))
            self._count(len(self._times), inside)

    def _count(self, starts: int, inside: int) -> None:
        """Count the windows of the first `starts` messages; only `inside` of them end within the time span."""
        times, begins = self._times, self._times[:starts]
        most = np.searchsorted(times, begins + self.length_ns, "left") - np.searchsorted(
            times, begins, "left"
        )
        self._note(most, most > self.max_count, highest=True)
        if inside:
            first_after = np.searchsorted(times, begins[:inside], "right")
            least = np.searchsorted(times, begins[:inside] + self.length_ns, "right") - first_after
            self._note(least, least < self.min_count, highest=False)
        self._times = times[starts:]
        self._index += starts

    def _note(self, counts: NDArray[np.intp], is_bad: NDArray[np.bool_], *, highest: bool) -> None:
        position = int(counts.argmax() if highest else counts.argmin())
        extreme = self._extreme(counts, position)
        record = self.highest if highest else self.lowest
        if record is None or (extreme.count > record.count if highest else extreme.count < record.count):
            if highest:
                self.highest = extreme
            else:
                self.lowest = extreme
        if is_bad.any():
            self.violations += int(is_bad.sum())
            first = self._extreme(counts, int(is_bad.argmax()))
            if self.first is None or first.start_ns < self.first.start_ns:
                self.first = first

    def _extreme(self, counts: NDArray[np.intp], position: int) -> WindowExtreme:
        return WindowExtreme(int(counts[position]), int(self._times[position]), self._index + position)


@dataclass(slots=True)
class TopicTimes:
    """The log times of one topic: count, span, longest interval, and the accumulators of its expectations."""

    gaps: dict[str, Gaps] = field(default_factory=dict[str, Gaps])
    """By the key of the expectation."""
    windows: dict[str, SlidingWindow] = field(default_factory=dict[str, SlidingWindow])
    count: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    longest: Gap | None = None
    late: int = 0
    """Number of batches that start before the end of the batch before them: gaps and windows are unknown then."""
    _previous: int | None = None

    @property
    def span_ns(self) -> int:
        """The time between the first and the last message."""
        return 0 if self.first_ns is None or self.last_ns is None else self.last_ns - self.first_ns

    def add(self, times: Int64s) -> None:
        """Add the log times of a batch, which are sorted."""
        if not len(times):
            return
        first, last = int(times[0]), int(times[-1])
        self.first_ns = first if self.first_ns is None else min(self.first_ns, first)
        self.last_ns = last if self.last_ns is None else max(self.last_ns, last)
        index = self.count
        self.count += len(times)
        if self._previous is not None and first < self._previous:
            self.late += 1
        if not self.late:
            self._add_intervals(times, index)
            for window in self.windows.values():
                window.add(times)
        self._previous = last

    def finish(self) -> None:
        """Complete the accumulators after the last batch."""
        for gaps in self.gaps.values():
            gaps.finish()
        for window in self.windows.values():
            window.finish()

    def _add_intervals(self, times: Int64s, index: int) -> None:
        if self._previous is None:
            ends, index = times[1:], index + 1
            intervals = np.diff(times)
        else:
            ends = times
            intervals = np.diff(times, prepend=self._previous)
        if not len(intervals):
            return
        position = int(intervals.argmax())
        length = int(intervals[position])
        if self.longest is None or length > self.longest.length_ns:
            end = int(ends[position])
            self.longest = Gap(end - length, end, index + position)
        for gaps in self.gaps.values():
            gaps.add(intervals, ends, index)
