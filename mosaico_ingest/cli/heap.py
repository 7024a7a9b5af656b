"""This file keeps a long-running process's memory from growing with the number of threads it has had."""

from __future__ import annotations

import ctypes
from contextlib import suppress

import pyarrow as pa

__all__ = ["share_heaps"]

_M_ARENA_MAX = -8
"""glibc's name for the number of heaps."""


def share_heaps(count: int = 2) -> None:
    """Let all threads allocate from a few heaps: a server's many short-lived threads each keep one otherwise.

    Elsewhere than on glibc only Arrow's part is done.
    """
    pa.set_memory_pool(pa.system_memory_pool())
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, count)
