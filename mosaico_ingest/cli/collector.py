"""This file keeps Python's garbage collector out of the way while a command is imported."""

from __future__ import annotations

import gc

__all__ = ["collect_as_usual", "collect_rarely"]

_USUAL = gc.get_threshold()
_RARELY = 500_000
"""Objects made between two collections, more than all imports make: what an import makes is never garbage."""


def collect_rarely() -> None:
    """Put collections off while modules are imported: they took an eighth of the start-up."""
    gc.set_threshold(_RARELY, *_USUAL[1:])


def collect_as_usual() -> None:
    """Collect as usual once all is imported, and never look at that again: at the exit alone it took 70 ms."""
    gc.freeze()
    gc.set_threshold(*_USUAL)
