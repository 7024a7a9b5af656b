"""This file compares globs of topic names with each other, without any topic."""

from __future__ import annotations

from fnmatch import fnmatchcase

__all__ = ["bare", "covers", "is_glob"]


def is_glob(pattern: str) -> bool:
    """Say whether a pattern can match more than one name."""
    return any(character in pattern for character in "*?[")


def bare(pattern: str) -> str:
    """Return a pattern without the `!` that makes it an exclusion."""
    return pattern.removeprefix("!")


def covers(general: str, special: str) -> bool:
    """Say whether surely every name that `special` matches is matched by `general` as well."""
    if general in {"*", special}:
        return True
    if "[" in special:
        return False
    # What stands for a wildcard of `special` matches nothing in `general` but a wildcard.
    probes = (special.replace("*", filling).replace("?", "\x00") for filling in ("", "\x00", "/\x00/\x00"))
    return all(fnmatchcase(probe, general) for probe in probes)
