"""Tracks of topics on a shared time axis."""

from __future__ import annotations

import re

from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.pages.design import MAX_TICKS, MIN_BAR, WIDTH, draw_track, time_axis
from mosaico_ingest.report.parts import Gap, TimelineReport

S = 10**9
TWENTY_SECONDS = time_axis([0, 20 * S])
assert TWENTY_SECONDS is not None


def positions(path: str) -> list[float]:
    """Return the horizontal positions of a path."""
    return [float(number) for number in re.findall(r"[MH]([\d.]+)", path)]


@given(st.integers(0, 2 * 10**18), st.integers(1, 10**18))
def test_axis_ticks_are_regular_and_few(start_ns: int, duration_ns: int) -> None:
    axis = time_axis([start_ns + duration_ns, start_ns])
    assert axis is not None
    assert 1 <= len(axis.ticks) <= MAX_TICKS + 1
    assert axis.ticks[0].percent == 0
    assert all(0 <= tick.percent <= 100.001 for tick in axis.ticks)
    assert len({tick.label for tick in axis.ticks}) == len(axis.ticks)


def test_axis_without_times_does_not_exist() -> None:
    assert time_axis([]) is None


def test_axis_of_ten_minutes_has_ticks_in_minutes() -> None:
    axis = time_axis([0, 600 * S])
    assert axis is not None
    assert [tick.label for tick in axis.ticks] == ["0:00", "2:00", "4:00", "6:00", "8:00", "10:00"]


def test_track_one_gap_is_labelled_and_drawn_at_its_time() -> None:
    timeline = TimelineReport(
        start_ns=0,
        step_ns=S,
        counts=(50,) * 20,
        interval_ns=S // 50,
        gap_count=1,
        gaps=(Gap(start_ns=5 * S, end_ns=7_200_000_000),),
    )
    track = draw_track(TWENTY_SECONDS, "/a", timeline)
    assert track.label == "/a: 1,000 rows, 1 gap, 2.20 s"
    assert positions(track.gaps) == [WIDTH * 5 / 20, WIDTH * 7.2 / 20, WIDTH * 5 / 20]


def test_track_marks_rejected_and_unreadable_times() -> None:
    track = draw_track(
        TWENTY_SECONDS, "/a", None, rejected=[(0, 2 * S)], unreadable=[(10 * S, 40 * S), (-S, -1)]
    )
    assert positions(track.rejected) == [0, WIDTH / 10, 0]
    assert positions(track.unreadable) == [WIDTH / 2, WIDTH, WIDTH / 2]
    assert track.label == "/a: rejected messages in 1 range, 2 unreadable ranges"


def test_track_single_row_is_visible() -> None:
    timeline = TimelineReport(start_ns=10 * S, step_ns=10**6, counts=(1,))
    for times in ([0, 10 * S], [10 * S, 10 * S]):
        axis = time_axis(times)
        assert axis is not None
        left, *_, right = positions(draw_track(axis, "/a", timeline).rows)
        assert 0 <= left < right <= WIDTH
        assert right - left >= MIN_BAR - 0.1


def test_track_slow_regular_topic_has_one_level() -> None:
    timeline = TimelineReport(start_ns=0, step_ns=S, counts=((1, 0, 0) * 30 + (1,)), interval_ns=3 * S)
    axis = time_axis([0, 90 * S])
    assert axis is not None
    assert draw_track(axis, "/a", timeline).rows.count("V") == 2


@given(
    st.lists(st.integers(0, 1000), min_size=1, max_size=120),
    st.integers(1, 10**12),
    st.none() | st.integers(1, 10**12),
)
def test_track_of_any_counts_stays_on_the_axis(
    counts: list[int], step_ns: int, interval_ns: int | None
) -> None:
    timeline = TimelineReport(start_ns=0, step_ns=step_ns, counts=tuple(counts), interval_ns=interval_ns)
    axis = time_axis([0, step_ns * len(counts)])
    assert axis is not None
    drawn = positions(draw_track(axis, "/a", timeline).rows)
    assert all(0 <= position <= WIDTH for position in drawn)
    assert drawn == sorted(drawn)


def test_track_rows_end_at_the_last_row() -> None:
    timeline = TimelineReport(start_ns=0, step_ns=S, counts=(5,) * 8, interval_ns=S // 5)
    track = draw_track(TWENTY_SECONDS, "/a", timeline, span=(0, 7_600_000_000))
    assert positions(track.rows)[-1] == WIDTH * 7.6 / 20


def test_track_rows_close_together_are_a_visible_bar() -> None:
    timeline = TimelineReport(start_ns=0, step_ns=2_000_000, counts=(9, *(0,) * 98, 1), interval_ns=1_000_000)
    track = draw_track(TWENTY_SECONDS, "/a", timeline, span=(0, 200_000_000))
    left, right, *_ = positions(track.rows)[1:]
    assert right - left >= MIN_BAR - 0.1
