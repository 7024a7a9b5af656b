"""Removal of the calls that some platforms lack, to test the package as on macOS and, where possible, as on Windows.

Python imports this module at start-up if its folder is in PYTHONPATH; `pytest --portable` puts it there for all processes.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

REMOVED = (
    (os, "posix_fadvise"),  # Linux only
    (os, "POSIX_FADV_DONTNEED"),
    (os, "sched_getaffinity"),
    (os, "preadv"),  # not on older versions of macOS
    (os, "pread"),  # not on Windows, like the following
    (os, "setsid"),
    (os, "O_DIRECTORY"),
    (os, "fork"),
    (signal, "pthread_sigmask"),
)
MODULES = ("fcntl", "resource")
"""Modules that Windows does not have."""

for module, name in REMOVED:
    if hasattr(module, name):
        delattr(module, name)
for name in MODULES:
    sys.modules[name] = None  # importing it raises ImportError


class _LibraryWithoutMallopt(ctypes.CDLL):
    """The C library of a system other than Linux, as far as the package uses it."""

    def __getattr__(self, name: str) -> object:
        if name == "mallopt":
            raise AttributeError(name)
        return super().__getattr__(name)


ctypes.CDLL = _LibraryWithoutMallopt
