"""The reader of rosbag2's SQLite files (`.db3`), intact or damaged."""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from mosaico_ingest.errors import BagError
from mosaico_ingest.remote import AnyPath
from mosaico_ingest.rosbag.blocks import (
    EARLIEST_NS,
    LATEST_NS,
    Encoding,
    MessageBlock,
    ReadRequest,
    ReadResult,
    ReadTask,
    SplitConnection,
    UnreadableRange,
    group_by_bytes,
    rows_by_connection,
    undescribed_connections,
)
from mosaico_ingest.rosbag.definitions.model import Embedded

__all__ = [
    "BROKEN",
    "Row",
    "Salvage",
    "SqliteReader",
]

BROKEN = (sqlite3.Error, UnicodeDecodeError)
"""How damage shows; the second, where SQLite's message quotes a name that is damaged."""

Row = tuple[int, int, int, Any]
"""Row id, topic id, time stamp, payload; what SQLite keeps in the last column need not be bytes."""
_LAST_ROWID = 2**63 - 1


@dataclass(slots=True)
class Salvage:
    """Rows by row id instead of by time; what had to be stepped over is in `unreadable`."""

    database: sqlite3.Connection
    unreadable: list[UnreadableRange] = field(default_factory=list[UnreadableRange])

    def rows(self) -> Iterator[Row]:
        """Yield every row that can be read."""
        at = 0
        while True:
            try:
                for row in self._from(at):
                    at = max(at, row[0] + 1)
                    yield row
            except BROKEN as err:  # noqa: PERF203 - each stretch may end in damage of its own
                found = self._next_row(at)
                upto = "the end" if found is None else f"row {found[0]}"
                if found is None or found[0] > at:
                    self.unreadable.append(UnreadableRange(at, f"{err}: rows are missing before {upto}"))
                if found is None:
                    return
                yield found  # by itself: where the row behind it is damaged, a query for both may give neither
                at = found[0] + 1
            else:
                return

    def _from(self, rowid: int, limit: int = -1) -> Iterator[Row]:
        query = (
            "SELECT rowid, topic_id, timestamp, data FROM messages NOT INDEXED "
            "WHERE rowid >= ? ORDER BY rowid LIMIT ?"
        )
        yield from self.database.execute(query, (rowid, limit))

    def _next_row(self, broken: int) -> Row | None:
        """Return the first row from `broken` on that can be read, None without any: by doubling steps, then halving."""
        step, low, high = 1, broken - 1, broken
        while not self._is_readable(high):
            low, high, step = high, high + step, step * 2
            if high > _LAST_ROWID:
                return None
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if self._is_readable(middle) else (middle, high)
        found = next(self._from(high, 1), None)
        return found if found is not None and found[0] >= broken else None

    def _is_readable(self, rowid: int) -> bool:
        try:
            list(self._from(rowid, 1))
        except BROKEN:
            return False
        return True


_PAGE_ROWS = 1 << 16
_EVENT = "_Event"
"""The type of a service's events; its definition is that of the service, under the service's name."""
_ROW_TYPES = [int, int, int, bytes]


class _Done(Struct, frozen=True):
    """How far reading by time has come: up to `time_ns`, and of that very time these rows."""

    time_ns: int
    rows: set[int]

    def after(self, page: list[Row]) -> _Done:
        """Return the state with one more page."""
        last = int(page[-1][2])
        rows = {row[0] for row in page if row[2] == last}
        return _Done(last, rows | self.rows if last == self.time_ns else rows)

    def leaves(self, row: Row) -> bool:
        """Return whether the row has not been read."""
        return row[2] > self.time_ns or (row[2] == self.time_ns and row[0] not in self.rows)


class _Columns(Struct, frozen=True):
    """What the tables of this file have; rosbag2 added columns and tables over the years."""

    topics: frozenset[str]
    has_definitions: bool


class SqliteReader:
    """One `.db3` file."""

    container = "sqlite3"

    def __init__(self, path: Path, name: AnyPath | None = None) -> None:
        self.path: AnyPath = name or path
        self.unreadable: list[UnreadableRange] = []
        self.notes: list[str] = []
        self._stack = ExitStack()
        try:
            self._database = _open(path, self._stack, self.notes)
            self._columns = _columns(self._database)
            self._counts = self._read_counts()
            self.connections: tuple[SplitConnection, ...] = self._read_connections()
            self.message_count: int | None = None if self._counts is None else sum(self._counts.values())
            self.unreadable.extend(
                undescribed_connections(self._counts, {connection.id for connection in self.connections})
            )
            self.start_ns, self.end_ns = self._read_bounds()
        except (*BROKEN, OSError, TypeError, ValueError) as err:
            self._stack.close()
            raise BagError(f"the SQLite file cannot be read: {err}", where=str(self.path)) from err
        except BaseException:
            self._stack.close()
            raise

    def read_tasks(self, request: ReadRequest) -> Iterator[ReadTask]:
        """Yield pages of rows by time stamp; where a page of the file is damaged, what can still be found."""
        keys = ",".join(str(int(key)) for key in request.connections)
        query = (
            "SELECT rowid, topic_id, timestamp, data FROM messages "  # noqa: S608 - the keys are numbers
            f"WHERE topic_id IN ({keys}) AND timestamp BETWEEN ? AND ? ORDER BY timestamp"
        )
        bounds = (max(request.start_ns, EARLIEST_NS), min(request.end_ns - 1, LATEST_NS))
        done = _Done(bounds[0], set())
        try:
            for page in _pages(self._database.execute(query, bounds), request):
                done = done.after(page)
                yield ReadTask(int(page[0][2]), partial(_load, page))
        except BROKEN as err:
            yield from self._salvaged(request, done, str(err))

    def _salvaged(self, request: ReadRequest, done: _Done, reason: str) -> Iterator[ReadTask]:
        """Yield the rows that reading by time did not reach, in whatever order they are."""
        salvage = Salvage(self._database)
        wanted = (
            row
            for row in salvage.rows()
            if row[1] in request.connections and row[2] < request.end_ns and done.leaves(row)
        )
        for page in _pages(wanted, request):
            yield ReadTask(done.time_ns, partial(_load, page))
        unreadable = salvage.unreadable or [
            UnreadableRange(0, f"{reason}; every row could be read in another way", count=0)
        ]
        yield ReadTask(done.time_ns, lambda: ReadResult([], unreadable))

    def check_unchanged(self) -> None:
        """Do nothing; see `FileSource.check_unchanged`."""

    def close(self) -> None:
        """Close the file, and remove the copy, if there had to be one."""
        self._stack.close()

    def _read_connections(self) -> tuple[SplitConnection, ...]:
        definitions = self._read_definitions()
        names = [
            "id",
            "name",
            "type",
            "serialization_format",
            "offered_qos_profiles",
            "type_description_hash",
        ]
        present = [name for name in names if name in self._columns.topics]
        rows = self._database.execute(f"SELECT {','.join(present)} FROM topics ORDER BY id")  # noqa: S608 - constants
        return tuple(_stream(dict(zip(present, row, strict=True)), self._counts, definitions) for row in rows)

    def _read_counts(self) -> dict[int, int] | None:
        try:
            return dict(self._database.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
        except BROKEN as err:
            self.notes.append(f"the messages cannot be counted: {err}")
            return None

    def _read_definitions(self) -> dict[str, Embedded]:
        if not self._columns.has_definitions:
            return {}
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions ORDER BY id DESC"
        return {
            str(name): Embedded(str(encoding), _text(text))
            for name, encoding, text in self._database.execute(query)
        }

    def _read_bounds(self) -> tuple[int | None, int | None]:
        try:
            return self._database.execute("SELECT min(timestamp), max(timestamp) FROM messages").fetchone()
        except BROKEN as err:
            self.notes.append(f"the first and last time stamps cannot be read: {err}")
            return None, None


def _open(path: Path, stack: ExitStack, notes: list[str]) -> sqlite3.Connection:
    """Open read-only; a copy, where changes must be replayed first, or where the last page is not whole."""
    pending = [beside for suffix in ("-wal", "-journal") if _has_bytes(beside := Path(f"{path}{suffix}"))]
    whole_bytes = _whole_pages(path)
    if pending or whole_bytes < path.stat().st_size:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mosaico-")))
        for file in (path, *pending):
            shutil.copyfile(file, folder / file.name)
        path = folder / path.name
        os.truncate(path, whole_bytes)
    if pending:
        notes.append(f"{pending[0].name} holds changes; they were replayed on a copy")
    uri = f"{path.absolute().as_uri()}?{'mode=rw' if pending else 'mode=ro&immutable=1'}"
    database = sqlite3.connect(uri, uri=True, check_same_thread=False)
    stack.callback(database.close)
    database.text_factory = _text
    return database


def _whole_pages(path: Path) -> int:
    """Return the size without the page that is cut off: SQLite would take the missing bytes for zeros."""
    size = path.stat().st_size
    with path.open("rb") as file:
        page_bytes = int.from_bytes(file.read(18)[16:], "big")
    page_bytes = 1 << 16 if page_bytes == 1 else page_bytes
    return size - size % page_bytes if page_bytes else size


def _has_bytes(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > 0


def _text(value: object) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _tables(database: sqlite3.Connection) -> set[str]:
    """Return the names of the tables, also of a file that was cut off."""
    query = "SELECT name FROM sqlite_master WHERE type = 'table'"
    try:
        return {str(name) for (name,) in database.execute(query)}
    except BROKEN:
        # With this SQLite opens files shorter than their header says; nothing is ever written here.
        database.execute("PRAGMA writable_schema = ON")
        return {str(name) for (name,) in database.execute(query)}


def _columns(database: sqlite3.Connection) -> _Columns:
    tables = _tables(database)
    if not {"topics", "messages"} <= tables:
        raise BagError(
            f"a SQLite file without the tables of a recording; it has {', '.join(sorted(tables)) or 'none'}"
        )
    topics = frozenset(str(row[1]) for row in database.execute("PRAGMA table_info(topics)"))
    messages = {str(row[1]) for row in database.execute("PRAGMA table_info(messages)")}
    missing = ({"id", "name", "type"} - topics) | ({"topic_id", "timestamp", "data"} - messages)
    if missing:
        raise BagError(f"a SQLite file whose tables lack the columns {', '.join(sorted(missing))}")
    return _Columns(topics, "message_definitions" in tables)


def _stream(
    row: dict[str, Any], counts: dict[int, int] | None, definitions: dict[str, Embedded]
) -> SplitConnection:
    encoding = str(row.get("serialization_format", "cdr"))
    attributes = {"encoding": encoding}
    for name in ("offered_qos_profiles", "type_description_hash"):
        if row.get(name):
            attributes[name] = str(row[name])
    return SplitConnection(
        int(row["id"]),
        str(row["name"]),
        str(row["type"]),
        Encoding.CDR if encoding == "cdr" else Encoding.OTHER,
        2,
        definitions.get(str(row["type"])) or definitions.get(str(row["type"]).removesuffix(_EVENT)),
        None if counts is None else counts.get(int(row["id"]), 0),
        attributes=attributes,
    )


def _pages(rows: Iterator[Row], request: ReadRequest) -> Iterator[list[Row]]:
    """Yield rows in lists of the size of a block; one is read at a time, as its size is known only then."""
    return group_by_bytes(rows, _data_bytes, request.block_bytes, max_length=_PAGE_ROWS)


def _data_bytes(row: Row) -> int:
    return len(row[3]) if isinstance(row[3], bytes) else 0


def _load(page: list[Row]) -> ReadResult:
    """Return a page's rows by topic; SQLite keeps any value in any column, so the types are looked at."""
    good = [row for row in page if [type(value) for value in row] == _ROW_TYPES]
    unreadable = [
        UnreadableRange(row[0], "a row whose values have the wrong types", connection=row[1], count=1)
        for row in page
        if len(good) < len(page) and [type(value) for value in row] != _ROW_TYPES
    ]
    if not good:
        return ReadResult([], unreadable)
    ids, topics, times, blobs = zip(*good, strict=True)
    data = np.frombuffer(b"".join(blobs), np.uint8)
    lengths = np.fromiter(map(len, blobs), np.int64, len(blobs))
    starts = np.cumsum(lengths) - lengths
    all_times, all_ids = np.array(times, np.int64), np.array(ids, np.int64)
    keys = np.array(topics, np.int64)
    whole = MessageBlock(-1, all_times, data, starts, lengths, all_ids)
    blocks = [whole.rows(rows, connection=key) for key, rows in rows_by_connection(keys)]
    return ReadResult(blocks, unreadable)
