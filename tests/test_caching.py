"""What was made of an object is made once, for that object alone, and only so much of it is kept."""

from __future__ import annotations

from mosaico_ingest.caching import cache_by_identity


class _Given:
    """Equal to every other, as two Arrow types may be."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Given)

    def __hash__(self) -> int:
        return 0


def test_an_object_is_asked_once_and_an_equal_one_for_itself() -> None:
    asked: list[_Given] = []
    made = cache_by_identity(lambda given: asked.append(given) or len(asked))
    one, other = _Given(), _Given()
    assert [made(one), made(one), made(other), made(one)] == [1, 1, 2, 1]
    assert list(map(id, asked)) == [id(one), id(other)]


def test_an_object_lives_while_it_is_remembered_so_its_place_is_nobody_elses() -> None:
    made = cache_by_identity(lambda given: given)
    assert len({id(made(_Given())) for _ in range(100)}) == 100


def test_the_oldest_is_forgotten() -> None:
    asked: list[int] = []
    made = cache_by_identity(asked.append)
    given = list(range(10_000, 11_000))
    for each in (*given, given[-1], given[0]):
        made(each)
    assert asked == [*given, given[0]]
