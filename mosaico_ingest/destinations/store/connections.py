"""Connections to SQLite catalogs, and their reuse while a handle keeps a catalog open."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable, Generator
from contextlib import closing, contextmanager
from pathlib import Path
from threading import Lock

BUSY_S = 30.0
"""Seconds that a call waits for other writers."""


def connect(path: Path, query: str) -> sqlite3.Connection:
    """Open a connection; `query` holds the parameters of the file's URI."""
    uri = f"{path.absolute().as_uri()}?{query}"
    db = sqlite3.connect(uri, uri=True, timeout=BUSY_S, isolation_level=None, check_same_thread=False)
    try:
        db.row_factory = sqlite3.Row
        db.execute("PRAGMA foreign_keys = ON")
        db.execute("PRAGMA synchronous = FULL")
        db.execute("SELECT count(*) FROM sqlite_master")
    except sqlite3.Error:
        db.close()
        raise
    return db


class OpenCatalog:
    """The connections to one catalog file that calls reuse; each call has a connection for itself."""

    def __init__(self, path: Path) -> None:
        self.file = _identity(path)
        self.handles = 0
        self.is_current = False
        """Whether the tables have all columns of this version."""
        self._idle = [connect(path, "mode=rw")]

    @contextmanager
    def connection(self, path: Path) -> Generator[sqlite3.Connection, None, None]:
        """Yield a connection for reading and writing, and keep it unless the block fails."""
        try:
            db = self._idle.pop()
        except IndexError:
            db = connect(path, "mode=rw")
        try:
            yield db
        except BaseException:
            db.close()
            raise
        if self.handles:
            self._idle.append(db)
        else:
            db.close()

    def close(self) -> None:
        """Close all idle connections; the last one to close a catalog writes its log back."""
        while self._idle:
            self._idle.pop().close()


class Handle:
    """Keeps a catalog open until it is closed."""

    def __init__(self, key: tuple[int, str], catalog: OpenCatalog) -> None:
        self._key = key
        self._catalog: OpenCatalog | None = catalog

    def close(self) -> None:
        """Close the handle; a second call has no effect."""
        catalog, self._catalog = self._catalog, None
        if catalog is None or self._key[0] != os.getpid():
            return
        with _LOCK:
            catalog.handles -= 1
            if catalog.handles:
                return
            if _OPEN.get(self._key) is catalog:
                del _OPEN[self._key]
        catalog.close()


_OPEN: dict[tuple[int, str], OpenCatalog] = {}
"""The open catalogs by process and path: a forked process must not use the connections of its parent."""
_LOCK = Lock()


def keep_open(path: Path) -> Handle:
    """Keep a catalog open, so that calls need no new connection and closing one costs no checkpoint."""
    key = _key(path)
    with _LOCK:
        catalog = _OPEN.get(key)
        if catalog is None or catalog.file != _identity(path):
            catalog = _OPEN[key] = OpenCatalog(path)
        catalog.handles += 1
    return Handle(key, catalog)


def find_open(path: Path) -> OpenCatalog | None:
    """Return the open catalog of a path; None if there is none, or if another file has replaced it."""
    catalog = _OPEN.get(_key(path))
    if catalog is None:
        return None
    try:
        return catalog if catalog.file == _identity(path) else None
    except OSError:
        return None


@contextmanager
def connection(
    path: Path, open_connection: Callable[[], sqlite3.Connection]
) -> Generator[sqlite3.Connection, None, None]:
    """Yield a connection of the open catalog, or a new one, which is closed afterwards."""
    catalog = find_open(path)
    if catalog is not None:
        with catalog.connection(path) as db:
            yield db
        return
    with closing(open_connection()) as db:
        yield db


def _key(path: Path) -> tuple[int, str]:
    return os.getpid(), os.path.abspath(path)  # noqa: PTH100 - half the time of `Path.absolute`


def _identity(path: Path) -> tuple[int, int]:
    properties = path.stat()
    return properties.st_dev, properties.st_ino
