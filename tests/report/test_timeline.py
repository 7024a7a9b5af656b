"""A timeline counts every row, in equal stretches that are never too many."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.report.timing import MOST_STRETCHES, Timeline

BATCHES = st.lists(st.lists(st.integers(-(10**18), 2 * 10**18), max_size=20), max_size=6)


@given(BATCHES)
def test_every_row_is_in_its_stretch_whatever_the_order(batches: list[list[int]]) -> None:
    timeline = Timeline()
    for batch in batches:
        timeline.add(np.array(batch, np.int64))
    times = [time for batch in batches for time in batch]
    found = timeline.report()
    if found is None:
        assert not times
        return
    expected = np.bincount([(time - found.start_ns) // found.step_ns for time in times])
    assert found.counts == tuple(expected)
    assert len(found.counts) <= MOST_STRETCHES


def test_a_drop_out_is_a_stretch_without_rows() -> None:
    timeline = Timeline()
    seconds = np.r_[0:40, 60:100]
    timeline.add((seconds * 10**9).astype(np.int64))
    found = timeline.report()
    assert found is not None
    gap = round(20e9 / found.step_ns)
    assert "0" * (gap - 1) in "".join(str(min(count, 1)) for count in found.counts)
