from __future__ import annotations

import copy
import pickle
from dataclasses import asdict, dataclass, field, replace

import pytest

from mosaico_ingest.frozen import frozen


@frozen
class Place:
    """Where something is."""

    name: str
    line: int = 1
    seen: list[int] = field(default_factory=list[int], compare=False, repr=False)


@dataclass(frozen=True)
class Twin:
    """What `Place` would be as a dataclass of the standard library, without what is compared."""

    name: str
    line: int = 1


@frozen
class Nothing:
    pass


def test_two_of_equal_values_are_equal_and_hash_alike_whatever_is_not_compared() -> None:
    one, two = Place("a", 2, [1]), Place("a", 2, [2])
    assert one == two
    assert hash(one) == hash(two) == hash(Twin("a", 2))
    assert one != Place("a", 3)
    assert len({one, two, Place("b", 2)}) == 2


def test_one_of_another_class_is_never_equal() -> None:
    assert Place("a") != Twin("a")
    assert Nothing() == Nothing()
    assert hash(Nothing()) == hash(Nothing())
    assert Nothing() != Place("a")


def test_it_shows_as_a_dataclass_does() -> None:
    assert repr(Place("a", 2)) == repr(Twin("a", 2)).replace("Twin", "Place")
    assert repr(Nothing()) == "Nothing()"


def test_it_is_a_dataclass_to_the_standard_library() -> None:
    assert replace(Place("a"), line=7) == Place("a", 7)
    assert asdict(Place("a")) == {"name": "a", "line": 1, "seen": []}


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])  # noqa: S301 - our own bytes
def test_copies_are_equal(again: object) -> None:
    assert callable(again)
    assert again(Place("a", 2, [3])) == Place("a", 2)


def test_there_is_no_place_for_attributes_nobody_declared() -> None:
    with pytest.raises(AttributeError):
        Place("a").nme = "b"  # type: ignore[attr-defined] # the mistake this is about


def test_methods_of_the_class_itself_stay() -> None:
    @frozen
    class Loud:
        name: str

        def __repr__(self) -> str:
            return self.name.upper()

    assert repr(Loud("a")) == "A"
    assert Loud("a") == Loud("a")
