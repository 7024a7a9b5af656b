from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.decode import layout as gather
from mosaico_ingest.decode.layout import Cells, bytes_at, copy_slices, fixed_cells

DATA = np.random.default_rng(1).integers(0, 256, 60_000).astype(np.uint8)


def slow_spans(at: list[int], sizes: list[int]) -> bytes:
    return b"".join(DATA[start : start + size].tobytes() for start, size in zip(at, sizes, strict=True))


@pytest.mark.parametrize("largest", [4, 300, 20_000])
@given(data=st.data())
def test_copy_slices_returns_bytes_in_order(data: st.DataObject, largest: int) -> None:
    pairs = data.draw(st.lists(st.tuples(st.integers(0, 40_000), st.integers(0, largest)), max_size=20))
    at, sizes = [start for start, _ in pairs], [size for _, size in pairs]
    cells = copy_slices(DATA, np.array(at, np.int64), np.array(sizes, np.int64))
    assert cells.tobytes() == slow_spans(at, sizes)


@given(pairs=st.lists(st.tuples(st.integers(0, 40_000), st.integers(0, 300)), max_size=20))
def test_copy_slices_distant_slices_are_copied_without_take(pairs: list[tuple[int, int]]) -> None:
    at, sizes = [start for start, _ in pairs], [size for _, size in pairs]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gather, "_FAR_BYTES", 100)
        cells = copy_slices(DATA, np.array(at, np.int64), np.array(sizes, np.int64))
    assert cells.tobytes() == slow_spans(at, sizes)


def bytes_of(found: Cells, size: int) -> bytes:
    return found.numbers(np.dtype(np.uint8), 0, [(size, 1)]).tobytes()


@given(at=st.lists(st.integers(0, 50_000), max_size=20), size=st.integers(1, 5000))
def test_fixed_cells_returns_bytes_at_offsets(at: list[int], size: int) -> None:
    cells = fixed_cells(DATA, np.array(at, np.int64), size)
    assert bytes_of(cells, size) == slow_spans(at, [size] * len(at))


@given(st.integers(0, 9000), st.integers(1, 500), st.integers(1, 90), st.integers(1, 5000))
def test_fixed_cells_equidistant_offsets_are_a_view(begin: int, stride: int, count: int, size: int) -> None:
    at = begin + stride * np.arange(count)
    cells = fixed_cells(DATA, at, size)
    assert np.shares_memory(cells.data, DATA)
    assert bytes_of(cells, size) == slow_spans(at.tolist(), [size] * count)
    assert bytes_at(DATA, at).tobytes() == DATA[at].tobytes()
    assert copy_slices(DATA, at, np.full(count, size)).tobytes() == bytes_of(cells, size)


def test_fixed_cells_of_size_zero_read_nothing() -> None:
    assert fixed_cells(DATA, np.zeros(0, np.int64), 8).numbers(np.dtype("<u4"), 4).size == 0


def test_copy_slices_adjacent_slices_are_a_view() -> None:
    cells = copy_slices(DATA, np.array([10, 15, 20]), np.array([5, 5, 1]))
    assert np.shares_memory(cells, DATA)
    assert cells.tobytes() == DATA[10:21].tobytes()
