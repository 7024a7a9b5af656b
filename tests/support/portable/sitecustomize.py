"""Removal of the calls that only Linux has, to test the package as on another POSIX system.

Python imports this module at start-up if its folder is in PYTHONPATH; `pytest --portable` puts it there for all processes.
"""

from __future__ import annotations

import ctypes
import fcntl
import os

REMOVED = (
    (os, "posix_fadvise"),
    (os, "POSIX_FADV_DONTNEED"),
    (os, "sched_getaffinity"),
    (fcntl, "F_SETLEASE"),
)

for module, name in REMOVED:
    if hasattr(module, name):
        delattr(module, name)


class _LibraryWithoutMallopt(ctypes.CDLL):
    """The C library of a system other than Linux, as far as the package uses it."""

    def __getattr__(self, name: str) -> object:
        if name == "mallopt":
            raise AttributeError(name)
        return super().__getattr__(name)


ctypes.CDLL = _LibraryWithoutMallopt  # type: ignore[misc]
