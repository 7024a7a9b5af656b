"""Identity-keyed caching for arguments that are as expensive to hash as the result is to compute.

Arrow types and schemas are such arguments: they are hashed by their text.
`functools.lru_cache` would hash them, and `cachetools.cached(key=id)` would not keep them alive, so ids could be reused.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import TypeVar

_Argument = TypeVar("_Argument")
_Result = TypeVar("_Result")
_MAX_ENTRIES = 256
"""Maximum number of cached results. Successive recordings have the same topics, so they share most results."""


def cache_by_identity(function: Callable[[_Argument], _Result]) -> Callable[[_Argument], _Result]:
    """Cache the results of a function by the identity of its argument, and evict the oldest; use it as a decorator."""
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
