"""SQLite files behind URLs: an SQLite database whose pages are read by range.

Python's `sqlite3` has no virtual file systems, so the extra `remote` installs APSW, which contains its own SQLite.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, cast

import apsw

from mosaico_ingest.rosbag.source import CachedSource


class RemoteDatabase:
    """A read-only database behind a URL, with the part of the interface of `sqlite3.Connection` that readers use.

    Queries raise errors of `sqlite3` for damage, and `Unreachable` if the server does not respond.
    """

    def __init__(self, source: CachedSource, stack: ExitStack, *, size: int) -> None:
        """Open the first `size` bytes of a file; `stack` closes the database."""
        files = _Files(_File(source, size), name=f"mosaico-{id(source)}")
        stack.callback(files.unregister)
        flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
        with _translate_errors():
            self._connection = apsw.Connection("file:recording?immutable=1", flags=flags, vfs=files.name)
        stack.callback(self._connection.close)

    def execute(self, query: str, parameters: Sequence[int] = (), /) -> _Rows:
        """Run a query."""
        with _translate_errors():
            return _Rows(self._connection.execute(query, parameters))


class _Rows:
    def __init__(self, cursor: apsw.Cursor) -> None:
        self._cursor = cursor

    def __iter__(self) -> Iterator[Any]:
        with _translate_errors():
            yield from self._cursor

    def fetchone(self) -> Any:  # noqa: ANN401 - SQLite stores values of any type in any column
        return next(iter(self), None)


@contextmanager
def _translate_errors() -> Generator[None, None, None]:
    try:
        yield
    except apsw.Error as err:
        raise sqlite3.DatabaseError(str(err)) from err


class _Files(apsw.VFS):
    """A virtual file system with one file."""

    def __init__(self, file: _File, *, name: str) -> None:
        super().__init__(name=name, base="")
        self.name = name
        self._file = file

    def xFullPathname(self, name: str) -> str:  # noqa: N802 - a name of SQLite
        return name

    def xAccess(self, pathname: str, flags: int) -> bool:  # noqa: ARG002, N802 - a name and arguments of SQLite
        return False

    def xOpen(self, name: str | apsw.URIFilename | None, flags: list[int]) -> apsw.VFSFile:  # noqa: ARG002, N802 - a name and arguments of SQLite
        return cast("apsw.VFSFile", self._file)  # APSW accepts any object with the methods that SQLite calls


class _File:
    """The file of a database; the methods that SQLite calls for an immutable file."""

    def __init__(self, source: CachedSource, size: int) -> None:
        self._source = source
        self._size = size

    def xRead(self, amount: int, offset: int) -> bytes:  # noqa: N802 - a name of SQLite
        return self._source.read_some(offset, min(amount, max(self._size - offset, 0)))

    def xFileSize(self) -> int:  # noqa: N802 - a name of SQLite
        return self._size

    def xFileControl(self, operation: int, pointer: int) -> bool:  # noqa: ARG002, N802 - a name and arguments of SQLite
        return False

    def xClose(self) -> None:  # noqa: N802 - a name of SQLite
        """Do nothing: the reader closes the source."""
