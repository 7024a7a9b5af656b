"""Property tests: accumulators give the same result for any size of batches as a plain computation over all values."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosaico_ingest.contracts.rows import AllowedTexts
from mosaico_ingest.contracts.times import PERIOD_SAMPLE, FileOrder, Gaps, SlidingWindow, TopicTimes
from mosaico_ingest.contracts.values import (
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
    Values,
)
from mosaico_ingest.job.values import Interval, Limit
from mosaico_ingest.rosbag.blocks import MessageBlock

TIMES = st.lists(st.integers(0, 60), min_size=1, max_size=60).map(sorted)
CUTS = st.lists(st.integers(0, 60), max_size=6)
NUMBERS = st.one_of(
    st.none(), st.sampled_from([math.nan, math.inf, -math.inf]), st.integers(-5, 5).map(float)
)


def parts(length: int, cuts: list[int]) -> list[slice]:
    edges = sorted({0, length, *(cut for cut in cuts if cut < length)})
    return [slice(start, end) for start, end in pairwise(edges)]


def batches(times: list[int], cuts: list[int]) -> list[tuple[slice, Batch]]:
    array = np.array(times, np.int64)
    indexes = np.arange(len(times), dtype=np.int64)
    return [(part, Batch(array[part], 0, indexes[part])) for part in parts(len(times), cuts)]


def as_values(values: list[float | None]) -> Values:
    null = np.array([value is None for value in values])
    data = np.array([0.0 if value is None else value for value in values])
    return Values(data, null if null.any() else None, None)


@given(TIMES, CUTS, st.integers(0, 20))
def test_gaps_any_batch_size_finds_all_long_intervals(times: list[int], cuts: list[int], limit: int) -> None:
    topic = TopicTimes(gaps={"gap": Gaps(Interval(ns=limit))})
    for _, batch in batches(times, cuts):
        topic.add(batch.log_times)
    topic.finish()
    gaps = topic.gaps["gap"]
    intervals = [(end - start, end, index + 1) for index, (start, end) in enumerate(pairwise(times))]
    expected = [interval for interval in intervals if interval[0] > limit]
    found = zip(gaps.lengths.tolist(), gaps.ends.tolist(), gaps.indexes.tolist(), strict=True)
    assert list(found) == expected
    assert gaps.total == len(intervals)
    assert (topic.count, topic.first_ns, topic.last_ns) == (len(times), times[0], times[-1])
    longest = max((interval[0] for interval in intervals), default=None)
    assert (None if topic.longest is None else topic.longest.length_ns) == longest


@given(TIMES, CUTS, st.sampled_from([1.0, 2.0, 2.5]))
def test_gaps_in_periods_any_batch_size_uses_median_of_first_intervals(
    times: list[int], cuts: list[int], periods: float
) -> None:
    gaps = Gaps(Interval(periods=periods))
    topic = TopicTimes(gaps={"gaps": gaps})
    for _, batch in batches(times, cuts):
        topic.add(batch.log_times)
    topic.finish()
    intervals = np.diff(np.array(times))
    if len(intervals):
        limit = int(periods * float(np.median(intervals[:PERIOD_SAMPLE])))
        assert gaps.limit_ns == limit
        assert gaps.lengths.tolist() == intervals[intervals > limit].tolist()


@given(st.integers(0, 3), st.integers(1, 4))
def test_gaps_in_periods_long_topic_fixes_the_period_early(extra: int, batch: int) -> None:
    """Intervals after the sample do not change the period."""
    times = np.concatenate([np.arange(PERIOD_SAMPLE + 1) * 10, 10_010 + np.arange(3000) * (50 + extra)])
    gaps = Gaps(Interval(periods=2.0))
    topic = TopicTimes(gaps={"gaps": gaps})
    for part in np.array_split(times, batch * 7):
        topic.add(part)
    topic.finish()
    assert gaps.limit_ns == 20
    assert len(gaps.lengths) == 2999


@given(TIMES, CUTS, st.integers(1, 25))
def test_sliding_window_any_batch_size_equals_window_by_window_count(
    times: list[int], cuts: list[int], length: int
) -> None:
    window = SlidingWindow(length, min_count=2, max_count=4)
    for _, batch in batches(times, cuts):
        window.add(batch.log_times)
    window.finish()
    most = [sum(start <= time < start + length for time in times) for start in times]
    least = [
        sum(start < time <= start + length for time in times)
        for start in times
        if start + length <= times[-1]
    ]
    assert window.highest is not None
    assert window.highest.count == max(most)
    assert (None if window.lowest is None else window.lowest.count) == min(least, default=None)
    assert window.violations == sum(count > 4 for count in most) + sum(count < 2 for count in least)


def test_topic_times_late_batch_is_counted_and_not_measured() -> None:
    topic = TopicTimes(gaps={"gap": Gaps(Interval(ns=1))})
    topic.add(np.array([10, 20], np.int64))
    topic.add(np.array([5], np.int64))
    topic.finish()
    assert (topic.late, topic.count, topic.first_ns, topic.last_ns) == (1, 3, 5, 20)


@given(st.lists(NUMBERS, min_size=1, max_size=40), CUTS)
def test_value_accumulators_any_batch_size_equal_plain_computation(
    values: list[float | None], cuts: list[int]
) -> None:
    limits, finite, nulls = NumberLimits(-2, 2), FiniteNumbers(), Nulls(Limit(count=0))
    allowed, moments = AllowedValues((0.0, 1.0)), Moments()
    for part, batch in batches(list(range(len(values))), cuts):
        of_part = as_values(values[part])
        for accumulator in (limits, finite, nulls, allowed, moments):
            accumulator.add(batch, of_part)
    known = [value for value in values if value is not None]
    outside = [i for i, value in enumerate(values) if value is not None and not -2 <= value <= 2]
    assert limits.violations.count == len(outside)
    assert (limits.violations.first.index if limits.violations.first else None) == next(iter(outside), None)
    assert finite.violations.count == sum(not math.isfinite(value) for value in known)
    assert nulls.violations.count == len(values) - len(known)
    assert allowed.violations.count == sum(value not in (0.0, 1.0) for value in known)
    numbers = [value for value in known if math.isfinite(value)]
    assert moments.count == len(numbers)
    if numbers:
        assert moments.mean == pytest.approx(np.mean(numbers), abs=1e-9)
        assert moments.std == pytest.approx(np.std(numbers), abs=1e-9)


@given(st.lists(NUMBERS, min_size=1, max_size=40), CUTS)
def test_changes_any_batch_size_equal_differences_of_neighbors(
    values: list[float | None], cuts: list[int]
) -> None:
    changes = Changes(low=1, high=3)
    for part, batch in batches(list(range(len(values))), cuts):
        changes.add(batch, as_values(values[part]))
    plain = [
        abs(right - left)
        for left, right in pairwise(math.nan if value is None else value for value in values)
        if math.isfinite(right - left)
    ]
    assert changes.count == len(plain)
    assert changes.violations.count == sum(not 1 <= change <= 3 for change in plain)
    assert (changes.lowest, changes.highest) == (min(plain, default=None), max(plain, default=None))


@given(st.lists(NUMBERS, min_size=1, max_size=40), CUTS, st.integers(0, 10), st.integers(1, 5))
def test_unchanged_any_batch_size_measures_runs_of_equal_values(
    values: list[float | None], cuts: list[int], limit: int, step: int
) -> None:
    times = [index * step for index in range(len(values))]
    unchanged = Unchanged(limit)
    for part, batch in batches(times, cuts):
        unchanged.add(batch, as_values(values[part]))
    unchanged.finish()
    runs: list[list[int]] = []
    previous: Any = object()
    for time, value in zip(times, values, strict=True):
        key = "nan" if value is not None and math.isnan(value) else value
        if runs and key == previous:
            runs[-1][1] = time
        else:
            runs.append([time, time])
        previous = key
    lengths = [end - start for start, end in runs]
    assert unchanged.longest_ns == max(lengths)
    assert unchanged.violations.count == sum(length > limit for length in lengths)


@given(st.lists(st.integers(0, 8), min_size=1, max_size=40), CUTS, st.booleans())
def test_stamp_steps_any_batch_size_count_violations(
    stamps: list[int],
    cuts: list[int],
    monotonic: bool,  # noqa: FBT001 - an argument of hypothesis
) -> None:
    steps = Steps(monotonic=monotonic)
    for part, batch in batches(list(range(len(stamps))), cuts):
        steps.add(batch, np.array(stamps[part], np.int64))
    bad = [
        i + 1
        for i, (left, right) in enumerate(pairwise(stamps))
        if (right < left if monotonic else right == left)
    ]
    assert steps.violations.count == len(bad)
    assert (steps.violations.first.index if steps.violations.first else None) == next(iter(bad), None)


@given(st.lists(st.integers(0, 8), min_size=1, max_size=40), CUTS)
def test_latency_any_batch_size_counts_zero_stamps_as_violations(stamps: list[int], cuts: list[int]) -> None:
    latency = LatencyRange(None, 3)
    times = [index // 4 for index in range(len(stamps))]
    for part, batch in batches(times, cuts):
        latency.add(batch, np.array(stamps[part], np.int64))
    known = [time - stamp for time, stamp in zip(times, stamps, strict=True) if stamp]
    assert latency.unset == stamps.count(0)
    assert latency.violations.count == stamps.count(0) + sum(value > 3 for value in known)
    assert (latency.lowest.value if latency.lowest else None) == min(known, default=None)
    assert (latency.highest.value if latency.highest else None) == max(known, default=None)


@given(st.lists(st.sampled_from(["imu", "base", None]), min_size=1, max_size=20), CUTS)
def test_allowed_texts_any_batch_size_counts_other_texts(texts: list[str | None], cuts: list[int]) -> None:
    allowed = AllowedTexts(("imu",))
    for part, batch in batches(list(range(len(texts))), cuts):
        allowed.add(batch, pa.array(texts[part], pa.string()))
    assert allowed.violations.count == sum(text != "imu" for text in texts)


def test_missing_numbers_wrap_around_and_restart_are_no_gaps() -> None:
    numbers = MissingNumbers()
    for part in ([2**32 - 2, 2**32 - 1, 0, 1], [4, 5], [0, 1]):
        array = np.array(part, np.int64)
        numbers.add(Batch(array), array)
    assert (numbers.missing, numbers.violations.count) == (2, 1)


@settings(max_examples=60)
@given(
    st.lists(st.tuples(st.integers(0, 6), st.integers(0, 20)), min_size=1, max_size=40),
    st.permutations(range(7)),
)
def test_file_order_chunks_in_any_order_equal_steps_in_the_file(
    messages: list[tuple[int, int]], order: list[int]
) -> None:
    """Each message is (chunk, log time); chunks are read in another order than that of the file."""
    chunks = {chunk: [time for owner, time in messages if owner == chunk] for chunk in range(7)}
    file_order = FileOrder(has_numbers=False)
    for chunk in order:
        times = np.array(chunks[chunk], np.int64)
        if len(times):
            starts = np.arange(len(times), dtype=np.int64)
            offsets = np.full(len(times), chunk * 100, np.int64)
            data = np.zeros(len(times), np.uint8)
            file_order.add(0, 5, MessageBlock(5, times, data, starts, np.ones_like(starts), offsets))
    in_file = [time for chunk in range(7) for time in chunks[chunk]]
    steps = [left - right for left, right in pairwise(in_file) if right < left]
    found = file_order.steps_back(5)
    assert (found.count, found.total) == (len(steps), sum(steps))
    assert (found.worst.size if found.worst else None) == max(steps, default=None)
