"""This file remembers what was made of an object for as long as it is used, where comparing it would cost as much as making it.

Arrow types and schemas hash by spelling themselves out.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import TypeVar

__all__ = ["cache_by_identity"]

_Given = TypeVar("_Given")
_Made = TypeVar("_Made")
_MOST = 256
"""How many are remembered; the topics of one recording are those of the next."""


def cache_by_identity(make: Callable[[_Given], _Made]) -> Callable[[_Given], _Made]:
    """Make a function remember its results by the identity of its argument (a decorator)."""
    # What is remembered holds its argument, whose identity is not used again then.
    known: dict[int, tuple[_Given, _Made]] = {}
    lock = Lock()

    def recall(given: _Given) -> _Made:
        found = known.get(id(given))
        if found is None:
            found = (given, make(given))
            with lock:
                while len(known) >= _MOST:
                    del known[next(iter(known))]
                known[id(given)] = found
        return found[1]

    return recall
