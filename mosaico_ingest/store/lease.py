"""This file is how a writer shows that it lives: a lock the operating system drops with the process.

SQLite takes the lock, because it does so on every platform, also between threads of one process, and
without passing it on to a forked child.
"""

from __future__ import annotations

import sqlite3
from pathlib import Path

__all__ = ["Lease", "is_live"]


class Lease:
    """An exclusive lock on the file at `path`, held until `release` or the end of the process."""

    def __init__(self, path: Path) -> None:
        self._db = sqlite3.connect(path, timeout=0, isolation_level=None, check_same_thread=False)
        try:
            self._db.execute("BEGIN EXCLUSIVE")
        except sqlite3.Error:
            self._db.close()
            raise

    def release(self) -> None:
        """Release the lock."""
        self._db.close()


def is_live(path: Path) -> bool:
    """Return whether a process holds the lock at `path`."""
    if not path.is_file():
        return False
    try:
        Lease(path).release()
    except sqlite3.OperationalError as err:
        return "locked" in str(err)
    return False
