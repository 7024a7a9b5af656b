"""A timeline counts every row in a limited number of bins, and finds the gaps between rows."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.report.parts import MAX_BINS, MAX_GAPS, Timeline, TimelineReport

BATCHES = st.lists(st.lists(st.integers(-(10**18), 2 * 10**18), max_size=20), max_size=6)


def report_of(seconds: np.typing.ArrayLike, batch_rows: int = 1000) -> TimelineReport:
    """Return the timeline of rows at these times, added in batches."""
    times_ns = (np.asarray(seconds, np.float64) * 1e9).astype(np.int64)
    timeline = Timeline()
    for start in range(0, len(times_ns), batch_rows):
        timeline.add(times_ns[start : start + batch_rows])
    report = timeline.report()
    assert report is not None
    return report


def gap_seconds(report: TimelineReport) -> list[tuple[float, float]]:
    return [(gap.start_ns / 1e9, gap.end_ns / 1e9) for gap in report.gaps]


@given(BATCHES)
def test_timeline_rows_in_any_order_are_counted_in_their_bins(batches: list[list[int]]) -> None:
    timeline = Timeline()
    for batch in batches:
        timeline.add(np.array(batch, np.int64))
    times = [time for batch in batches for time in batch]
    report = timeline.report()
    if report is None:
        assert not times
        return
    assert report.counts == tuple(np.bincount([(time - report.start_ns) // report.step_ns for time in times]))
    assert len(report.counts) <= MAX_BINS
    assert len(report.gaps) <= report.gap_count
    assert all(gap.start_ns in times and gap.end_ns in times for gap in report.gaps)


@pytest.mark.parametrize("batch_rows", [1, 7, 1000])
def test_timeline_drop_out_is_one_gap_with_its_real_length(batch_rows: int) -> None:
    seconds = np.r_[np.arange(0, 10, 0.1), np.arange(12.1, 20, 0.1)]
    report = report_of(seconds, batch_rows)
    assert report.gap_count == 1
    assert gap_seconds(report) == [(pytest.approx(9.9), pytest.approx(12.1))]
    assert report.interval_ns == pytest.approx(0.1e9, rel=0.13)


@pytest.mark.parametrize("seconds", [[0], [0, 1], [0, 1, 2], [0, 5, 10.5, 15], [3, 3, 3]])
def test_timeline_few_regular_rows_have_no_gap(seconds: list[float]) -> None:
    report = report_of(seconds)
    assert (report.gap_count, report.gaps) == (0, ())


def test_timeline_few_rows_with_drop_out_have_one_gap() -> None:
    assert gap_seconds(report_of([0, 1, 2, 12, 13])) == [(2, 12)]


def test_timeline_irregular_rows_have_few_gaps() -> None:
    seconds = np.cumsum(np.random.default_rng(7).exponential(1.0, 2000))
    assert report_of(seconds).gap_count < 40


def test_timeline_jitter_is_no_gap() -> None:
    seconds = np.arange(0, 100, 0.02) + np.random.default_rng(7).uniform(0, 0.02, 5000)
    assert report_of(seconds).gap_count == 0


def test_timeline_many_gaps_lists_the_longest() -> None:
    intervals = np.full(5000, 0.01)
    intervals[::50] = np.linspace(1, 2, 100)
    report = report_of(np.cumsum(intervals), batch_rows=300)
    assert report.gap_count == 99  # the first interval has no row before it
    assert len(report.gaps) == MAX_GAPS
    assert min(gap.end_ns - gap.start_ns for gap in report.gaps) >= 1.49e9
    assert gap_seconds(report) == sorted(gap_seconds(report))


@pytest.mark.parametrize("batch_rows", [7, 10_000])
def test_timeline_jitter_is_the_standard_deviation_of_intervals_without_gaps(batch_rows: int) -> None:
    intervals = np.random.default_rng(7).normal(0.1, 0.005, 5000)
    seconds = np.cumsum(np.insert(intervals, 2500, 60.0))
    report = report_of(seconds, batch_rows)
    assert report.gap_count == 1
    assert report.jitter_ns == pytest.approx(np.std(intervals) * 1e9, rel=0.01)


def test_timeline_of_one_interval_has_no_jitter() -> None:
    assert report_of([0, 1]).jitter_ns is None
