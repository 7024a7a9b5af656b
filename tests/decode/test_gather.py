from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.decode import gather
from mosaico_ingest.decode.gather import cells, spans

DATA = np.random.default_rng(1).integers(0, 256, 60_000).astype(np.uint8)


def slow_spans(at: list[int], sizes: list[int]) -> bytes:
    return b"".join(DATA[start : start + size].tobytes() for start, size in zip(at, sizes, strict=True))


@pytest.mark.parametrize("largest", [4, 300, 20_000])
@given(data=st.data())
def test_spans_are_the_bytes_of_each_span_in_order(data: st.DataObject, largest: int) -> None:
    pairs = data.draw(st.lists(st.tuples(st.integers(0, 40_000), st.integers(0, largest)), max_size=20))
    at, sizes = [start for start, _ in pairs], [size for _, size in pairs]
    found = spans(DATA, np.array(at, np.int64), np.array(sizes, np.int64))
    assert found.tobytes() == slow_spans(at, sizes)


@given(pairs=st.lists(st.tuples(st.integers(0, 40_000), st.integers(0, 300)), max_size=20))
def test_spans_far_apart_are_found_without_reserving_what_lies_between(pairs: list[tuple[int, int]]) -> None:
    at, sizes = [start for start, _ in pairs], [size for _, size in pairs]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gather, "_FAR", 100)
        found = spans(DATA, np.array(at, np.int64), np.array(sizes, np.int64))
    assert found.tobytes() == slow_spans(at, sizes)


@given(at=st.lists(st.integers(0, 50_000), max_size=20), size=st.integers(0, 5000))
def test_cells_are_the_bytes_at_each_position(at: list[int], size: int) -> None:
    found = cells(DATA, np.array(at, np.int64), size)
    assert found.shape == (len(at), size)
    assert found.tobytes() == slow_spans(at, [size] * len(at))


def test_spans_that_follow_each_other_are_not_copied() -> None:
    found = spans(DATA, np.array([10, 15, 20]), np.array([5, 5, 1]))
    assert np.shares_memory(found, DATA)
    assert found.tobytes() == DATA[10:21].tobytes()
