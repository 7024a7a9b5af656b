"""`cache_by_identity`: one result per object, also for equal objects, up to a maximum number of objects."""

from __future__ import annotations

from mosaico_ingest.lazy import cache_by_identity


class _AlwaysEqual:
    """An object that equals every other one, as two Arrow types can."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _AlwaysEqual)

    def __hash__(self) -> int:
        return 0


def test_cache_computes_once_per_object_also_for_equal_objects() -> None:
    computed: list[_AlwaysEqual] = []
    cached = cache_by_identity(lambda value: computed.append(value) or len(computed))
    one, other = _AlwaysEqual(), _AlwaysEqual()
    assert [cached(one), cached(one), cached(other), cached(one)] == [1, 1, 2, 1]
    assert list(map(id, computed)) == [id(one), id(other)]


def test_cache_keeps_objects_alive_so_that_ids_are_not_reused() -> None:
    cached = cache_by_identity(lambda value: value)
    assert len({id(cached(_AlwaysEqual())) for _ in range(100)}) == 100


def test_cache_full_evicts_the_oldest_entry() -> None:
    computed: list[int] = []
    cached = cache_by_identity(computed.append)
    values = list(range(10_000, 11_000))
    for value in (*values, values[-1], values[0]):
        cached(value)
    assert computed == [*values, values[0]]
