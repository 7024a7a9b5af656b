"""Parts of reports that other documents contain, too: the results of data contracts, and the timelines of topics."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from datetime import datetime, timezone
from enum import Enum
from typing import Literal

import numpy as np
from msgspec import Struct, field
from numpy.typing import NDArray
from pydantic import ConfigDict, computed_field

from mosaico_ingest.documents import Part
from mosaico_ingest.findings import Finding, Severity, Span

MAX_BINS = 120
"""Maximum number of bins of a timeline."""
MAX_GAPS = 50
"""Maximum number of gaps that a timeline lists; the longest are kept."""
FIRST_BIN_NS = 1_000_000
"""Initial length of a bin, in ns."""
GAP_FACTOR = 3
"""A gap is longer than this many median intervals."""
IRREGULAR_FACTOR = 2
"""With `MIN_IRREGULAR` intervals or more, a gap is also longer than this many 90th percentiles of them."""
MIN_IRREGULAR = 20
_BUCKETS_PER_OCTAVE = 8
_MANTISSA_SHIFT = 49  # leaves the exponent and three bits of the mantissa of a float64
_EXPONENT_BIAS = 1023 * _BUCKETS_PER_OCTAVE
_BUCKETS = 64 * _BUCKETS_PER_OCTAVE


class ReportPart(Part):
    """The base of the parts of a report."""

    # Computed fields are written for other programs and ignored when a report is read.
    model_config = ConfigDict(extra="ignore", defer_build=True)


class Outcome(str, Enum):
    """The outcome of one expectation."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"
    """The expectation was not evaluated; `text` has the reason."""


class Location(ReportPart):
    """The location of an expectation in a manifest; lines and columns start at 1, and the end column is exclusive."""

    file: str
    line: int
    column: int
    end_line: int
    end_column: int

    @classmethod
    def of(cls, span: Span) -> Location:
        """Return a span as a part of a report."""
        return cls(
            file=span.file,
            line=span.line,
            column=span.column,
            end_line=span.end_line,
            end_column=span.end_column,
        )

    @property
    def span(self) -> Span:
        """The location as a span."""
        return Span(self.file, self.line, self.column, self.end_line, self.end_column)


class Occurrence(ReportPart):
    """One violation of an expectation."""

    log_time_ns: int | None = None
    """Log time of the message, in ns since the epoch; for an interval, of the message that ends it."""
    index: int | None = None
    """Position of the message on its topic in log-time order, from 0."""
    value: bool | int | float | str | None = None
    """The value, in the unit of the result."""


class ExpectationResult(ReportPart):
    """The result of one expectation for the recording or one of its topics."""

    expectation: str
    """The key path of the expectation, such as `expect.topics./imu.rate`."""
    severity: Severity
    """`error` or `warning`."""
    outcome: Outcome
    text: str
    """The result in one line, such as `the longest gap is 2.1 s, at most 50 ms expected`."""
    key: str = ""
    """The part of the key path below the recording or topic, such as `rate` or `fields.linear_acceleration.z.between`."""
    topic: str | None = None
    """The topic in the recording; None for an expectation of the recording or of a group."""
    location: Location | None = None
    """The location of the expectation's key; None without a manifest."""
    measured: bool | int | float | str | None = None
    """The measured value, in `unit`."""
    limit: str = ""
    """The expected value in words, such as `at most 50 ms`."""
    unit: str = ""
    """The unit of `measured` and of the occurrences: Hz, ns, messages, share, or empty."""
    violations: int = 0
    """Number of violations."""
    first: Occurrence | None = None
    """The first violation, if violations have a position."""
    worst: Occurrence | None = None
    """The violation that is farthest from the limit."""
    explained: int = 0
    """Number of violations that are not counted because events of the recorder explain them."""

    @property
    def passed(self) -> bool:
        """Whether the expectation did not fail."""
        return self.outcome is not Outcome.FAILED

    @property
    def line(self) -> str:
        """The result in one line, with its topic."""
        return f"{self.topic}: {self.text}" if self.topic else self.text

    @property
    def finding(self) -> Finding | None:
        """The result as a finding; None for an expectation that passed without explained violations."""
        text = self.line
        span = None if self.location is None else self.location.span
        if self.outcome is Outcome.FAILED:
            severity = self.severity
            return Finding("expectation-failed", severity, text, span)
        if self.outcome is Outcome.SKIPPED:
            return Finding("expectation-skipped", Severity.INFO, text, span)
        return Finding("expectation-explained", Severity.INFO, text, span) if self.explained else None


class ContractResult(ReportPart):
    """The results of all expectations of one recording."""

    on_failure: Literal["fail", "warn", "divert"]
    """The action if an expectation with the severity `error` fails."""
    results: tuple[ExpectationResult, ...] = ()
    stored_as: str | None = None
    """The name of the sequence that a recording was diverted to."""

    @computed_field
    @property
    def passed(self) -> bool:
        """Whether no expectation with the severity `error` failed."""
        return not self.errors

    @property
    def errors(self) -> tuple[ExpectationResult, ...]:
        """The failed expectations with the severity `error`."""
        return tuple(one for one in self.results if not one.passed and one.severity is Severity.ERROR)

    @property
    def warnings(self) -> tuple[ExpectationResult, ...]:
        """The failed expectations with the severity `warning`."""
        return tuple(one for one in self.results if not one.passed and one.severity is Severity.WARNING)


class Gap(Part):
    """An interval between two rows that is much longer than the topic's other intervals."""

    start_ns: int
    """Time of the row before the gap, in ns since the epoch."""
    end_ns: int
    """Time of the row after the gap, in ns since the epoch."""


class TimelineReport(Part):
    """The rows of a topic over time, in bins of equal length, and the gaps between them."""

    start_ns: int
    """Start of the first bin, in ns since the epoch."""
    step_ns: int
    """Length of a bin, in ns."""
    counts: tuple[int, ...]
    """Rows in each bin."""
    interval_ns: int | None = None
    """Median interval between two rows, in ns; null with fewer than two different times."""
    jitter_ns: int | None = None
    """Standard deviation of the intervals that are not gaps, in ns; null with fewer than two of them."""
    gap_count: int = 0
    """Number of gaps."""
    gaps: tuple[Gap, ...] = ()
    """The longest gaps, ordered by time."""


class Timeline(Struct):
    """Counts of rows and of the intervals between them; times may come in any order."""

    step_ns: int = FIRST_BIN_NS
    first: int = 0
    """Number of the first bin, counted from the epoch."""
    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    _last_ns: int | None = None
    _intervals: NDArray[np.int64] = field(default_factory=lambda: np.zeros(_BUCKETS, np.int64))
    """A histogram of the intervals with logarithmic buckets; see `_bucket_start_ns`."""
    _sums: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, _BUCKETS)))
    """The sum of the intervals of each bucket and the sum of their squares, in ns and ns²."""
    _longest: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    """Start and end of the longest intervals, in any order."""

    def add(self, times_ns: NDArray[np.int64]) -> None:
        """Add rows at these times, in ns since the epoch."""
        if not len(times_ns):
            return
        times_ns = np.sort(times_ns, kind="stable")  # linear in the usual case that they are sorted
        self._add_counts(times_ns)
        self._add_intervals(times_ns)

    def _add_counts(self, times_ns: NDArray[np.int64]) -> None:
        low, high = int(times_ns[0]) // self.step_ns, int(times_ns[-1]) // self.step_ns
        if len(self.counts):
            low, high = min(low, self.first), max(high, self.first + len(self.counts) - 1)
        factor = 1
        while high // factor - low // factor >= MAX_BINS:
            factor *= 2
        bins = (np.arange(len(self.counts)) + self.first) // factor
        self.step_ns *= factor
        self.first = low // factor
        counts = np.bincount(times_ns // self.step_ns - self.first, minlength=high // factor - self.first + 1)
        np.add.at(counts, bins - self.first, self.counts)
        self.counts = counts

    def _add_intervals(self, times_ns: NDArray[np.int64]) -> None:
        last_ns = self._last_ns
        self._last_ns = int(times_ns[-1]) if last_ns is None else max(last_ns, int(times_ns[-1]))
        if last_ns is not None and last_ns <= times_ns[0]:
            times_ns = np.concatenate(([last_ns], times_ns))
        intervals = np.diff(times_ns)
        buckets = _buckets(intervals)
        self._intervals += np.bincount(buckets, minlength=_BUCKETS)
        self._sums[0] += np.bincount(buckets, intervals, minlength=_BUCKETS)
        self._sums[1] += np.bincount(buckets, intervals.astype(np.float64) ** 2, minlength=_BUCKETS)
        is_full = len(self._longest) == MAX_GAPS
        minimum = int((self._longest[:, 1] - self._longest[:, 0]).min()) if is_full else 0
        starts = np.flatnonzero(intervals > minimum)
        if len(starts):
            candidates = np.column_stack((times_ns[starts], times_ns[starts + 1]))
            longest = np.concatenate((self._longest, candidates))
            if len(longest) > MAX_GAPS:
                lengths = longest[:, 1] - longest[:, 0]
                longest = longest[np.argpartition(lengths, -MAX_GAPS)[-MAX_GAPS:]]
            self._longest = longest

    def report(self) -> TimelineReport | None:
        """Return the counts and the gaps; None without rows."""
        if not len(self.counts):
            return None
        interval_ns, gap_bucket = self._median_and_gap_bucket()
        gaps = self._longest[_buckets(self._longest[:, 1] - self._longest[:, 0]) >= gap_bucket].tolist()
        return TimelineReport(
            start_ns=self.first * self.step_ns,
            step_ns=self.step_ns,
            counts=tuple(self.counts.tolist()),
            interval_ns=interval_ns,
            jitter_ns=self._jitter_ns(gap_bucket),
            gap_count=int(self._intervals[gap_bucket:].sum()),
            gaps=tuple(Gap(start_ns=start, end_ns=end) for start, end in sorted(gaps)),
        )

    def _jitter_ns(self, gap_bucket: int) -> int | None:
        """Return the standard deviation of the intervals below a bucket, in ns; None with fewer than two."""
        count = int(self._intervals[:gap_bucket].sum())
        if count < 2:  # noqa: PLR2004 - one interval does not vary
            return None
        mean, mean_square = self._sums[:, :gap_bucket].sum(axis=1) / count
        return round(math.sqrt(max(mean_square - mean * mean, 0.0)))

    def _median_and_gap_bucket(self) -> tuple[int | None, int]:
        """Return the median interval in ns, within 13 %, and the first bucket of intervals that are gaps."""
        totals = np.cumsum(self._intervals[1:])  # without rows at the same time
        total = int(totals[-1])
        if not total:
            return None, _BUCKETS
        median = int(np.searchsorted(totals, (total + 1) // 2)) + 1
        limit_ns = GAP_FACTOR * _bucket_start_ns(median + 1)
        if total >= MIN_IRREGULAR:
            percentile = int(np.searchsorted(totals, np.ceil(0.9 * total))) + 1
            limit_ns = max(limit_ns, IRREGULAR_FACTOR * _bucket_start_ns(percentile + 1))
        return _bucket_start_ns(median), min(int(_buckets(np.array([limit_ns]))[0]) + 1, _BUCKETS)


class Step(str, Enum):
    """A step of a run whose time is measured."""

    PREPARE = "prepare"
    READ = "read"
    DECODE = "decode"
    ADAPT = "adapt"
    WAIT = "wait"
    COMMIT = "commit"
    WRITE = "write"


class Stopwatch:
    """Assigns all elapsed time to steps; the writing thread adds its time separately, as it runs in parallel."""

    def __init__(self) -> None:
        self.began_at = datetime.now(timezone.utc)
        self._began = self._last = self._paused = time.perf_counter()
        self._seconds = dict.fromkeys(Step, 0.0)

    @property
    def elapsed_s(self) -> float:
        """Seconds since the stopwatch was created."""
        return time.perf_counter() - self._began

    @property
    def seconds(self) -> Mapping[Step, float]:
        """Seconds per step so far."""
        return self._seconds

    def lap(self, step: Step) -> None:
        """Add the time since the last lap to a step."""
        now = time.perf_counter()
        self._seconds[step] += now - self._last
        self._last = now

    def pause(self) -> None:
        """Stop assigning time until `resume`."""
        self._paused = time.perf_counter()

    def resume(self, seconds: float) -> None:
        """Continue after a pause, of which the given seconds count as elapsed."""
        pause = time.perf_counter() - self._paused - seconds
        self._began += pause
        self._last += pause

    def add(self, step: Step, seconds: float) -> None:
        """Add time that another thread measured to a step."""
        self._seconds[step] += seconds


def _buckets(intervals_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the bucket of each interval: eight for each power of two, and bucket 0 for intervals up to 1 ns."""
    exponents = intervals_ns.astype(np.float64).view(np.int64) >> _MANTISSA_SHIFT
    return np.maximum(exponents - _EXPONENT_BIAS, 0)


def _bucket_start_ns(bucket: int) -> int:
    """Return the shortest interval of a bucket, in ns."""
    octave, part = divmod(bucket, _BUCKETS_PER_OCTAVE)
    return ((_BUCKETS_PER_OCTAVE + part) << octave) // _BUCKETS_PER_OCTAVE
