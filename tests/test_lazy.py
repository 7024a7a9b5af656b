"""Sequences whose elements are computed at each access."""

from __future__ import annotations

from itertools import chain

from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.lazy import LazySequence, concatenate

LISTS = st.lists(st.integers(), max_size=8)


@given(st.lists(LISTS, max_size=4), st.slices(20))
def test_lazy_sequence_concatenated_mapped_and_sliced_equals_lists(
    parts: list[list[int]], part: slice
) -> None:
    lazy = concatenate([LazySequence.of(items) for items in parts]).map(str)
    expected = list(map(str, chain.from_iterable(parts)))
    assert list(lazy) == expected
    assert [lazy[at] for at in range(len(lazy))] == expected
    assert list(lazy[part]) == [lazy[part][at] for at in range(len(lazy[part]))] == expected[part]
    assert list(lazy[part].samples) == expected


def test_lazy_sequence_computes_only_accessed_elements() -> None:
    computed: list[int] = []
    lazy = LazySequence(lambda at: computed.append(at) or at, range(1_000_000), [0])
    assert lazy[5::10][-1] == 999_995
    assert computed == [999_995]
    assert lazy.map(lambda value: value + 1).samples == [1]
