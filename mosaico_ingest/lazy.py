"""Values that are computed when they are needed: lazy sequences, and results cached by identity."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from itertools import accumulate
from threading import Lock
from typing import Generic, TypeVar, overload

T = TypeVar("T")
U = TypeVar("U")
_Argument = TypeVar("_Argument")
_Result = TypeVar("_Result")
_MAX_ENTRIES = 256
"""Maximum number of cached results. Successive recordings have the same topics, so they share most results."""


class LazySequence(Sequence[T], Generic[T]):
    """A sequence that computes an element at each access, so that its memory does not grow with its length.

    `samples` are elements that stand for all others, such as one job of each manifest. Slices and mapped sequences have
    the samples of the sequence that they come from.
    """

    def __init__(self, compute: Callable[[int], T], positions: range, samples: Sequence[T]) -> None:
        self._compute = compute
        self._positions = positions
        self.samples = samples

    @classmethod
    def of(cls, items: Sequence[T]) -> LazySequence[T]:
        """Return the sequence itself if it is lazy, otherwise a view of it in which every element is a sample."""
        return items if isinstance(items, LazySequence) else cls(items.__getitem__, range(len(items)), items)

    def map(self, function: Callable[[T], U]) -> LazySequence[U]:
        """Return the results of a function that is called at each access."""
        compute = self._compute
        return LazySequence(
            lambda position: function(compute(position)),
            self._positions,
            [function(sample) for sample in self.samples],
        )

    def __len__(self) -> int:
        return len(self._positions)

    @overload
    def __getitem__(self, index: int) -> T: ...
    @overload
    def __getitem__(self, index: slice) -> LazySequence[T]: ...
    def __getitem__(self, index: int | slice) -> T | LazySequence[T]:
        """Compute an element, or return a slice without computing its elements."""
        if isinstance(index, slice):
            return LazySequence(self._compute, self._positions[index], self.samples)
        return self._compute(self._positions[index])

    def __iter__(self) -> Iterator[T]:
        return map(self._compute, self._positions)


def concatenate(parts: Sequence[LazySequence[T]]) -> LazySequence[T]:
    """Return one sequence with the elements and samples of several."""
    starts = [0, *accumulate(map(len, parts))]

    def compute(position: int) -> T:
        part = bisect_right(starts, position) - 1
        return parts[part][position - starts[part]]

    return LazySequence(compute, range(starts[-1]), [sample for part in parts for sample in part.samples])


def cache_by_identity(function: Callable[[_Argument], _Result]) -> Callable[[_Argument], _Result]:
    """Cache the results of a function by the identity of its argument, and evict the oldest; use it as a decorator.

    It is for arguments that are as expensive to hash as the result is to compute, such as Arrow types and schemas, which
    are hashed by their text. `functools.lru_cache` would hash them, and `cachetools.cached(key=id)` would not keep them
    alive, so ids could be reused.
    """
    # Each entry contains its argument: while the argument is alive, no other object has its id.
    entries: dict[int, tuple[_Argument, _Result]] = {}
    lock = Lock()

    def cached(argument: _Argument) -> _Result:
        entry = entries.get(id(argument))
        if entry is None:
            entry = (argument, function(argument))
            with lock:
                while len(entries) >= _MAX_ENTRIES:
                    del entries[next(iter(entries))]
                entries[id(argument)] = entry
        return entry[1]

    return cached
