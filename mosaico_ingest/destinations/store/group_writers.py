"""Threads that encode and write row groups: groups of one topic in their order, groups of several topics in parallel."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

Group = Future[None]
"""A row group that is written or waits; its result is an error or None."""


class GroupWriters:
    """Writes row groups on threads. `submit` blocks while each thread has a group, which limits the memory."""

    def __init__(self, threads: int) -> None:
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="group")
        self._slots = threading.BoundedSemaphore(threads)
        self._error: BaseException | None = None

    def submit(self, previous: Group | None, write: Callable[[], None]) -> Group:
        """Write a group after the previous group of its topic; an error of that group is the error of this group too."""
        self._slots.acquire()
        return self._pool.submit(self._write, previous, write)

    def check(self) -> None:
        """Raise the first error of any group."""
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """Drop the groups that wait, and wait for the others."""
        self._pool.shutdown(cancel_futures=True)

    def _write(self, previous: Group | None, write: Callable[[], None]) -> None:
        try:
            if previous is not None:
                previous.result()  # it started earlier, so it does not wait for this thread
            write()
        except BaseException as error:
            self._error = self._error or error
            raise
        finally:
            self._slots.release()
