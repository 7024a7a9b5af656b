"""Topic globs: the selection of topics, and the pattern that applies to a topic."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase

from msgspec import Struct


class Selection(Struct, frozen=True):
    """The selected topics, and for each topic the position of the deciding pattern (None: the default)."""

    selected: tuple[str, ...]
    decided_by: dict[str, int | None]
    unused: tuple[int, ...]
    """Positions of the patterns that matched no topic."""


def select(patterns: Sequence[str], topics: Iterable[str]) -> Selection:
    """Apply `patterns` in order: a plain one selects the topics it matches, one with a leading `!` excludes them.

    A pattern matches the complete name and is case-sensitive; `*` also matches `/`. If every pattern excludes, all other
    topics are selected.
    """
    names = tuple(topics)
    default = all(pattern.startswith("!") for pattern in patterns)
    is_selected = dict.fromkeys(names, default)
    decided: dict[str, int | None] = dict.fromkeys(names)
    unused: list[int] = []
    for position, pattern in enumerate(patterns):
        glob = pattern.removeprefix("!")
        matched = [name for name in names if fnmatchcase(name, glob)]
        for name in matched:
            is_selected[name] = not pattern.startswith("!")
            decided[name] = position
        if not matched:
            unused.append(position)
    return Selection(tuple(name for name in names if is_selected[name]), decided, tuple(unused))


def first_match(patterns: Iterable[str], topic: str) -> str | None:
    """Return the pattern that applies to `topic`: its exact name before any glob, then the first glob listed."""
    globs = list(patterns)
    if topic in globs:
        return topic
    return next((glob for glob in globs if fnmatchcase(topic, glob)), None)


def is_glob(pattern: str) -> bool:
    """Return whether a pattern can match several names."""
    return any(character in pattern for character in "*?[")
