"""Streaming accumulators over the rows of one connection: header stamps, and the values of expressions.

Every accumulator counts the violations of one expectation and keeps the first and the worst of them. Batches arrive in
log-time order, and the state that is carried across batches makes the result independent of their size.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from msgspec import Struct, field
from numpy.typing import NDArray

from mosaico_ingest.job.values import Limit

Mask: TypeAlias = NDArray[np.bool_]
Value: TypeAlias = "bool | int | float | str | None"


class Values(Struct, frozen=True):
    """The values of an expression over a batch of rows."""

    data: NDArray[Any]
    """The values, with zero or an empty text in place of null, shape (n,)."""
    null: NDArray[np.bool_] | None
    """Where the values are null; None if no value is null."""
    rows: NDArray[np.int64] | None
    """The row of each value; None for one value per row."""

    def row(self, position: int) -> int:
        """Return the row of a value."""
        return position if self.rows is None else int(self.rows[position])


class Violation(Struct, frozen=True):
    """A message that violates an expectation."""

    log_time_ns: int
    index: int
    """Position on the topic."""
    value: Value


class Batch(Struct, frozen=True):
    """Consecutive messages of a topic, or some of them."""

    log_times: NDArray[np.int64]
    """Log time of each row, shape (n,)."""
    first: int = 0
    """Position on the topic of the first message."""
    positions: NDArray[np.int64] | None = None
    """Position of each row after `first`, shape (n,); None for one row per message."""

    @property
    def indexes(self) -> NDArray[np.int64]:
        """The position of each row on the topic, shape (n,)."""
        if self.positions is None:
            return np.arange(self.first, self.first + len(self.log_times), dtype=np.int64)
        return self.positions + self.first

    def violation(self, row: int, value: Any) -> Violation:  # noqa: ANN401 - a numpy scalar or a Python value
        """Return the violation of one row."""
        plain = value.item() if isinstance(value, np.generic) else value
        position = row if self.positions is None else int(self.positions[row])
        return Violation(int(self.log_times[row]), self.first + position, plain)


class Violations(Struct):
    """The number of violations, the first one, and the worst one."""

    count: int = 0
    first: Violation | None = None
    worst: Violation | None = None
    excess: float = -np.inf
    """The distance of the worst value from its limit."""

    def add(
        self, batch: Batch, values: Values, bad: Mask, excess: NDArray[np.floating] | None = None
    ) -> None:
        """Add the violations of a batch; without `excess`, the first one counts as the worst."""
        positions = np.flatnonzero(bad)
        if not len(positions):
            return
        self.count += len(positions)
        if self.first is None:
            self.first = _violation(batch, values, int(positions[0]))
        if excess is None:
            self.worst = self.worst or self.first
            return
        distances = excess[positions]
        distances = np.where(np.isnan(distances), np.inf, distances)
        most = int(distances.argmax())
        if float(distances[most]) > self.excess:
            self.excess = float(distances[most])
            self.worst = _violation(batch, values, int(positions[most]))


def _violation(batch: Batch, values: Values, position: int) -> Violation:
    is_null = values.null is not None and bool(values.null[position])
    return batch.violation(values.row(position), None if is_null else values.data[position])


def plain_values(data: NDArray[Any]) -> Values:
    """Return values without nulls, one per row."""
    return Values(data, None, None)


class LatencyRange(Struct):
    """Log time minus header stamp; a stamp of zero is a violation without a value."""

    min_ns: int | None
    max_ns: int | None
    count: int = 0
    unset: int = 0
    """Number of messages whose stamp is zero."""
    lowest: Violation | None = None
    highest: Violation | None = None
    violations: Violations = field(default_factory=Violations)

    def add(self, batch: Batch, stamps: NDArray[np.int64]) -> None:
        """Add the stamps of a batch."""
        if not len(stamps):
            return
        self.count += len(stamps)
        latency = batch.log_times - stamps
        unset = stamps == 0 if np.count_nonzero(stamps) < len(stamps) else None
        if unset is None:
            low, high = int(latency.argmin()), int(latency.argmax())
        else:
            self.unset += int(unset.sum())
            positions = np.flatnonzero(~unset)
            if not len(positions):
                self.violations.add(batch, Values(latency, unset, None), unset, np.zeros(len(stamps)))
                return
            low = int(positions[latency[positions].argmin()])
            high = int(positions[latency[positions].argmax()])
        if self.lowest is None or latency[low] < self.lowest.value:
            self.lowest = batch.violation(low, latency[low])
        if self.highest is None or latency[high] > self.highest.value:
            self.highest = batch.violation(high, latency[high])
        is_low = self.min_ns is not None and latency[low] < self.min_ns
        is_high = self.max_ns is not None and latency[high] > self.max_ns
        if is_low or is_high or unset is not None:
            self._add_violations(batch, latency, unset)

    def _add_violations(self, batch: Batch, latency: NDArray[np.int64], unset: Mask | None) -> None:
        excess = np.full(len(latency), -np.inf)
        if self.max_ns is not None:
            excess = np.maximum(excess, latency - float(self.max_ns))
        if self.min_ns is not None:
            excess = np.maximum(excess, float(self.min_ns) - latency)
        if unset is not None:
            excess[unset] = 0.0
        bad = excess > 0 if unset is None else (excess > 0) | unset
        self.violations.add(batch, Values(latency, unset, None), bad, excess)


class Steps(Struct):
    """The differences between consecutive header stamps: negative ones (`monotonic`) or zero (`unique`)."""

    monotonic: bool
    count: int = 0
    violations: Violations = field(default_factory=Violations)
    _previous: int | None = None

    def add(self, batch: Batch, stamps: NDArray[np.int64]) -> None:
        """Add the stamps of a batch."""
        if not len(stamps):
            return
        self.count += len(stamps)
        steps = differences(stamps, self._previous)
        if self._previous is None:
            steps[0] = 1
        self._previous = int(stamps[-1])
        is_good = int(steps.min()) >= 0 if self.monotonic else np.count_nonzero(steps) == len(steps)
        if not is_good:
            bad = steps < 0 if self.monotonic else steps == 0
            self.violations.add(batch, plain_values(steps), bad, -steps.astype(np.float64))


class MissingNumbers(Struct):
    """The sequence numbers that no message has, between consecutive messages."""

    count: int = 0
    missing: int = 0
    violations: Violations = field(default_factory=Violations)
    is_zero: bool = True
    """Whether every number is zero: the writer does not count."""
    _previous: int | None = None

    def add(self, batch: Batch, numbers: NDArray[np.int64]) -> None:
        """Add the sequence numbers of a batch, which wrap around at 2^32."""
        if not len(numbers):
            return
        self.count += len(numbers)
        steps = differences(numbers, self._previous)
        if self._previous is None:
            steps[0] = 1
        missing = missing_between(steps)
        self._previous = int(numbers[-1])
        self.is_zero = self.is_zero and not numbers.any()
        self.missing += int(missing.sum())
        self.violations.add(batch, plain_values(missing), missing > 0, missing.astype(np.float64))


def differences(values: NDArray[np.int64], previous: int | None) -> NDArray[np.int64]:
    """Return the difference of each value to the value before it, shape (n,); the first one is zero without `previous`."""
    result = np.empty_like(values)
    np.subtract(values[1:], values[:-1], out=result[1:])
    result[:1] = 0 if previous is None else values[:1] - previous
    return result


def missing_between(steps: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return how many sequence numbers each step skips; a step back is a restart, not a gap."""
    wrapped = np.where(steps < -(1 << 31), steps + (1 << 32), steps)
    return np.where(wrapped > 1, wrapped - 1, 0)


class NumberLimits(Struct):
    """Numbers between two bounds; NaN is outside of every range, and null inside."""

    low: float = -np.inf
    high: float = np.inf
    count: int = 0
    lowest: float | None = None
    highest: float | None = None
    violations: Violations = field(default_factory=Violations)

    def add(self, batch: Batch, values: Values) -> None:
        """Add the values of a batch."""
        data = values.data
        if not len(data):
            return
        self.count += len(data)
        numbers = data if values.null is None else data[~values.null]
        if not len(numbers):
            return
        low, high = numbers.min(), numbers.max()
        if np.isnan(low):
            finite = numbers[~np.isnan(numbers)]
            if len(finite):
                self._widen(finite.min(), finite.max())
        else:
            self._widen(low, high)
            if low >= self.low and high <= self.high:
                return
        bad = ~((data >= self.low) & (data <= self.high))
        if values.null is not None:
            bad &= ~values.null
        numbers = data.astype(np.float64)
        self.violations.add(batch, values, bad, np.maximum(numbers - self.high, self.low - numbers))

    def _widen(self, low: Any, high: Any) -> None:  # noqa: ANN401 - numpy scalars
        low, high = low.item(), high.item()
        self.lowest = low if self.lowest is None else min(self.lowest, low)
        self.highest = high if self.highest is None else max(self.highest, high)


class FiniteNumbers(Struct):
    """Numbers that are neither NaN nor infinite."""

    count: int = 0
    violations: Violations = field(default_factory=Violations)

    def add(self, batch: Batch, values: Values) -> None:
        """Add the values of a batch."""
        self.count += len(values.data)
        if not np.issubdtype(values.data.dtype, np.floating):
            return
        bad = ~np.isfinite(values.data)
        if bad.any():
            self.violations.add(batch, values, bad if values.null is None else bad & ~values.null)


class Nulls(Struct):
    """The number of nulls among the values."""

    limit: Limit
    count: int = 0
    violations: Violations = field(default_factory=Violations)

    def add(self, batch: Batch, values: Values) -> None:
        """Add the values of a batch."""
        self.count += len(values.data)
        if values.null is not None:
            self.violations.add(batch, values, values.null)


class AllowedValues(Struct):
    """Values that must be in a set; null is allowed."""

    allowed: tuple[Any, ...]
    count: int = 0
    violations: Violations = field(default_factory=Violations)

    def add(self, batch: Batch, values: Values) -> None:
        """Add the values of a batch."""
        data = values.data
        if not len(data):
            return
        self.count += len(data)
        good = data == self.allowed[0]
        for value in self.allowed[1:]:
            good = good | (data == value)
        if not good.all():
            bad = ~good
            self.violations.add(batch, values, bad if values.null is None else bad & ~values.null)


class Moments(Struct):
    """The mean and the standard deviation of the finite values."""

    count: int = 0
    mean: float = 0.0
    _squares: float = 0.0
    """Sum of the squared distances from the mean."""

    @property
    def std(self) -> float | None:
        """The standard deviation of the population; None without values."""
        return (self._squares / self.count) ** 0.5 if self.count else None

    def add(self, batch: Batch, values: Values) -> None:  # noqa: ARG002 - the signature of all accumulators
        """Add the values of a batch."""
        data = values.data.astype(np.float64, copy=False)
        selected = np.isfinite(data)
        if values.null is not None:
            selected &= ~values.null
        if not selected.all():
            data = data[selected]
        if not len(data):
            return
        mean = float(data.mean())
        squares = float(np.square(data - mean).sum())
        total = self.count + len(data)
        step = mean - self.mean
        self._squares += squares + step * step * self.count * len(data) / total
        self.mean += step * len(data) / total
        self.count = total


class Changes(Struct):
    """The absolute differences between the values of consecutive messages; one without a finite value has none."""

    low: float = -np.inf
    high: float = np.inf
    count: int = 0
    """Number of differences."""
    lowest: float | None = None
    highest: float | None = None
    violations: Violations = field(default_factory=Violations)
    _previous: float = np.nan

    def add(self, batch: Batch, values: Values) -> None:
        """Add the values of a batch, one per row."""
        data = values.data.astype(np.float64)
        if not len(data):
            return
        if values.null is not None:
            data[values.null] = np.nan
        with np.errstate(invalid="ignore"):
            changes = np.abs(np.diff(data, prepend=self._previous))
        self._previous = float(data[-1])
        finite_changes = changes[np.isfinite(changes)]
        if not len(finite_changes):
            return
        self.count += len(finite_changes)
        low, high = float(finite_changes.min()), float(finite_changes.max())
        self.lowest = low if self.lowest is None else min(self.lowest, low)
        self.highest = high if self.highest is None else max(self.highest, high)
        if low < self.low or high > self.high:
            with np.errstate(invalid="ignore"):
                bad = np.isfinite(changes) & ((changes < self.low) | (changes > self.high))
                excess = np.maximum(changes - self.high, self.low - changes)
            self.violations.add(batch, plain_values(changes), bad, excess)


class Unchanged(Struct):
    """The runs of consecutive messages with the same value; NaN equals NaN, and null equals null."""

    max_ns: int
    count: int = 0
    longest_ns: int = 0
    violations: Violations = field(default_factory=Violations)
    """One per run that is longer than the limit, at the message that ends it; the value is the length in ns."""
    _start_ns: int = 0
    _last: Violation | None = None
    """The last message so far."""
    _value: Any = None
    _is_null: bool = False

    def add(self, batch: Batch, values: Values) -> None:
        """Add the values of a batch, one per row."""
        data = values.data
        if not len(data):
            return
        self.count += len(data)
        null = np.zeros(len(data), bool) if values.null is None else values.null
        is_new = np.ones(len(data), bool)
        is_new[1:] = ~_same(data[1:], data[:-1], null[1:], null[:-1])
        if self._last is not None:
            previous = np.array([self._value], data.dtype)
            is_new[0] = not bool(_same(data[:1], previous, null[:1], np.array([self._is_null]))[0])
        starts = np.flatnonzero(is_new)
        times, indexes = batch.log_times, batch.indexes
        if self._last is not None and len(starts):
            ends = starts - 1
            begins = np.concatenate([[self._start_ns], times[starts[:-1]]])
            last_times = np.where(ends < 0, self._last.log_time_ns, times[ends])
            last_indexes = np.where(ends < 0, self._last.index, indexes[ends])
            self._close(begins, last_times, last_indexes)
        elif len(starts) > 1:
            ends = starts[1:] - 1
            self._close(times[starts[:-1]], times[ends], indexes[ends])
        if len(starts):
            self._start_ns = int(times[starts[-1]])
        self._last = batch.violation(len(data) - 1, 0)
        self._value, self._is_null = data[-1], bool(null[-1])

    def finish(self) -> None:
        """End the last run."""
        if self._last is not None:
            self._close(
                np.array([self._start_ns]), np.array([self._last.log_time_ns]), np.array([self._last.index])
            )
            self._last = None

    def _close(self, begins: NDArray[np.int64], ends: NDArray[np.int64], indexes: NDArray[np.int64]) -> None:
        lengths = ends - begins
        self.longest_ns = max(self.longest_ns, int(lengths.max()))
        excess = lengths - float(self.max_ns)
        self.violations.add(Batch(ends, 0, indexes), plain_values(lengths), excess > 0, excess)


def _same(left: NDArray[Any], right: NDArray[Any], null: Mask, other_null: Mask) -> Mask:
    equal = np.asarray(left == right)
    if np.issubdtype(left.dtype, np.floating):
        equal = equal | (np.isnan(left) & np.isnan(right))
    return (equal & ~null & ~other_null) | (null & other_null)


Accumulator: TypeAlias = (
    "NumberLimits | FiniteNumbers | Nulls | AllowedValues | Moments | Changes | Unchanged"
)
