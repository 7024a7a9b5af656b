"""The reader of rosbag2's SQLite files (`.db3`), intact or damaged.

SQLite has no checksums, and a damaged file often yields fewer rows without an error. Three independent numbers reveal
most of these cases: the rows of the table, the entries of the index on the timestamp, and the range of the row ids. If
they disagree, `PRAGMA quick_check` decides whether the file is damaged or rows were deleted.

* An intact file is read by timestamp. Afterwards the rows are compared with the counts, and `PRAGMA integrity_check`
  compares the table with its index and follows the payloads that span several pages.
* A damaged file, and the remainder of a file whose read fails or ends early, is read by row id (`RowScan`), which steps
  over unreadable pages. Rows that are still missing become an unreadable range.

If SQLite reports damage, a result that looks complete may contain wrong values, so it has an unreadable range of unknown
size. Only bytes of values that changed in place remain unnoticed.

A file behind a URL is read by range (`remote_sqlite`). Counting its rows would read most of it, so the rows are counted after
they have been read, and the pages of the complete file are checked only if all messages have been read.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from msgspec import Struct

from mosaico_ingest.errors import BagError
from mosaico_ingest.remote import AnyPath
from mosaico_ingest.rosbag.blocks import (
    EARLIEST_NS,
    LATEST_NS,
    ROSBAG2_ENTRY,
    ROSBAG2_RECORD,
    Encoding,
    Int64s,
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
from mosaico_ingest.rosbag.source import CachedSource

DAMAGE = (sqlite3.Error, UnicodeDecodeError, MemoryError, OverflowError)
"""Exceptions that damage causes: damaged names in SQLite's messages, and damaged sizes, have no exception of their own."""

Row = tuple[Any, Any, Any, Any]
"""Row id, topic id, timestamp, payload. SQLite stores values of any type in any column, so each row is checked."""
_ROW_TYPES = [int, int, int, bytes]
_MAX_ROWID = 2**63 - 1
_HEAD_BYTES = 18
"""Size of the start of the header, up to the page size."""
_MAX_PAGE_ROWS = 1 << 16
_MAX_BITMAP_ROWS = 1 << 28
_EVENT = "_Event"
"""Suffix of the type of service events; their definition is stored under the name of the service."""


class Cursor(Protocol):
    """The rows of a query."""

    def __iter__(self) -> Iterator[Any]:
        """Return the iterator over the remaining rows."""
        ...

    def fetchone(self) -> Any:  # noqa: ANN401 - SQLite stores values of any type in any column
        """Return the next row, None after the last."""
        ...


class Database(Protocol):
    """The interface of `sqlite3.Connection` that the reader uses; queries raise an error of `DAMAGE`."""

    def execute(self, query: str, parameters: Sequence[int] = (), /) -> Cursor:
        """Run a query."""
        ...


class SqliteReader:
    """The reader of one `.db3` file."""

    container = "sqlite3"

    def __init__(self, file: Path | CachedSource, name: AnyPath | None = None) -> None:
        self._source = None if isinstance(file, Path) else file
        self.path: AnyPath = name or (file if isinstance(file, Path) else file.path)
        self.unreadable: list[UnreadableRange] = []
        self.notes: list[str] = []
        self._stack = ExitStack()
        try:
            self._database: Database = (
                _open_database(file, self._stack, self.notes)
                if isinstance(file, Path)
                else _open_by_range(file, self._stack)
            )
            self._columns = _read_columns(self._database)
            self.connections: tuple[SplitConnection, ...] = self._read_connections()
            self.start_ns, self.end_ns = self._read_time_bounds()
        except (*DAMAGE, OSError, TypeError, ValueError) as err:
            self._stack.close()
            raise BagError(f"the SQLite file cannot be read: {err}", where=str(self.path)) from err
        except BaseException:
            self._stack.close()
            raise
        self.message_count: int | None = None
        if self._source is None:
            self.message_count = None if self._counts is None else self._totals.table_rows
            if self._totals.damage is not None:
                self.notes.append(f"the file is damaged and read row by row: {self._totals.damage}")
            self.unreadable += self._rows_without_connection()

    def read_tasks(self, request: ReadRequest) -> Iterator[ReadTask]:
        """Yield pages of rows by timestamp; in case of damage, the remaining rows by row id."""
        rows_read = _RowSet(*self._rowid_bounds)
        damage = self._totals.damage if self._source is None else None
        last_ns = EARLIEST_NS
        if damage is None:
            bounds = (max(request.start_ns, EARLIEST_NS), min(request.end_ns - 1, LATEST_NS))
            try:
                matches = iter(self._database.execute(_query(request), bounds))
                # A local file is read in large pages, which cost less; a reader behind a URL may stop early.
                max_rows = _MAX_PAGE_ROWS if self._source is None else request.block_rows
                for page in _pages(matches, request, max_rows=max_rows):
                    rows = rows_read.add(page)
                    last_ns = max(last_ns, _first_time(rows, default=last_ns))
                    yield ReadTask(_first_time(rows, default=last_ns), partial(_load, rows))
            except DAMAGE as err:
                damage = str(err)
            else:
                damage = self._damage_after_reading(request, rows_read)
            if self._source is not None and _is_unlimited(request):
                unreadable = self._rows_without_connection()
                yield ReadTask(last_ns, lambda: ReadResult([], unreadable))
        if damage is not None:
            yield from self._remaining_tasks(request, rows_read, damage, last_ns)

    def index_times(self, connections: Collection[int]) -> dict[int, list[Int64s]] | None:
        """Return the log times of some connections; None if the file is damaged."""
        if self._source is None and self._totals.damage is not None:
            return None
        try:
            rows = np.fromiter(
                self._database.execute(f"SELECT topic_id, timestamp FROM messages WHERE {_of(connections)}"),  # noqa: S608 - the keys are numbers
                np.dtype([("topic", np.int64), ("time", np.int64)]),
            )
        except (*DAMAGE, TypeError, ValueError):
            return None
        times: dict[int, list[Int64s]] = {key: [] for key in connections}
        for key, positions in rows_by_connection(rows["topic"]):
            times[key] = [rows["time"][positions]]
        return times

    @cached_property
    def _totals(self) -> _Totals:
        return _read_totals(self._database)

    @property
    def _counts(self) -> dict[int, int] | None:
        """The number of rows by topic, None if they cannot be counted."""
        return self._totals.by_topic if self._totals.damage is None else None

    @cached_property
    def _rowid_bounds(self) -> tuple[int, int]:
        try:
            return _read_rowid_bounds(self._database)
        except (*DAMAGE, TypeError, ValueError):
            return 0, -1

    def _rows_without_connection(self) -> list[UnreadableRange]:
        """Return the rows whose topic is unknown."""
        if self._counts is None:
            return []
        rows = undescribed_connections(self._counts, {connection.id for connection in self.connections})
        if self._totals.untyped_rows:
            reason = f"{self._totals.untyped_rows} rows whose topic id is not an integer"
            rows.append(UnreadableRange(0, reason, count=self._totals.untyped_rows))
        return rows

    def _damage_after_reading(self, request: ReadRequest, rows_read: _RowSet) -> str | None:
        """Return damage that reading a request did not reveal; check a file behind a URL only as far as it was read."""
        is_range = self._source is not None
        if is_range and not _is_unlimited(request):
            return None
        if self._totals.damage is not None:
            return self._totals.damage
        if any(self._missing_rows(request, rows_read).values()):
            return "the index on the timestamp is damaged"
        if is_range and not {connection.id for connection in self.connections} <= set(request.connections):
            return None
        return self._hidden_damage

    @cached_property
    def _hidden_damage(self) -> str | None:
        """Damage that reading did not reveal, found by a complete check of the file; None without damage."""
        return _check(self._database, "integrity_check")

    def metadata_records(self) -> dict[str, dict[str, str]]:
        """Return rosbag2's copy of `metadata.yaml` under the name of this record in MCAP files; empty without one."""
        try:
            row = self._database.execute("SELECT metadata FROM metadata ORDER BY id DESC").fetchone()
        except DAMAGE:  # older files have no such table
            return {}
        if row is None or not isinstance(row[0], str):
            return {}
        return {ROSBAG2_RECORD: {ROSBAG2_ENTRY: row[0]}}

    def check_unchanged(self) -> None:
        """Raise Unreachable if a file behind a URL has been replaced since it was opened."""
        if self._source is not None:
            self._source.check_unchanged()

    def close(self) -> None:
        """Close the file, and remove a temporary copy."""
        self._stack.close()

    def _remaining_tasks(
        self, request: ReadRequest, rows_read: _RowSet, damage: str, last_ns: int
    ) -> Iterator[ReadTask]:
        """Yield the rows that have not been read, by row id, and the unreadable ranges."""
        scan = RowScan(self._database)
        remaining = (row for row in scan.rows() if _is_requested(row, request))
        for page in _pages(remaining, request):
            rows = rows_read.add(page)
            if rows:
                yield ReadTask(last_ns, partial(_load, rows))
        unreadable = self._unreadable_rows(request, rows_read, scan, damage)
        yield ReadTask(last_ns, lambda: ReadResult([], unreadable))

    def _unreadable_rows(
        self, request: ReadRequest, rows_read: _RowSet, scan: RowScan, damage: str
    ) -> list[UnreadableRange]:
        """Return the missing rows: per connection if the counts are reliable, else in total or per gap."""
        if _is_unlimited(request) and self._counts is not None:
            offset = scan.gaps[0].offset if scan.gaps else 0
            missing = [
                UnreadableRange(offset, f"{damage}: {count} rows are missing", connection=key, count=count)
                for key, count in self._missing_rows(request, rows_read).items()
                if count > 0
            ]
            if missing:
                return missing
        if scan.gaps:
            return scan.gaps
        totals = self._totals
        counts = (totals.index_rows, totals.table_rows)
        if None in counts or len(scan.rowids) < max(*(count or 0 for count in counts), totals.rowid_range):
            return [UnreadableRange(0, f"{damage}: an unknown number of rows is missing")]
        return [UnreadableRange(0, f"{damage}: every row was read, but some may have wrong values")]

    def _missing_rows(self, request: ReadRequest, rows_read: _RowSet) -> dict[int, int]:
        """Return the number of missing rows by topic; empty if the request is limited in time."""
        if not _is_unlimited(request) or self._counts is None:
            return {}
        return {
            key: self._counts.get(key, 0) - rows_read.by_topic[key] for key in sorted(request.connections)
        }

    def _read_connections(self) -> tuple[SplitConnection, ...]:
        definitions = self._read_definitions()
        names = (
            "id",
            "name",
            "type",
            "serialization_format",
            "offered_qos_profiles",
            "type_description_hash",
        )
        present = [name for name in names if name in self._columns.topics]
        # Text that is read as bytes may be invalid UTF-8.
        columns = ["id", *(f"CAST({name} AS BLOB)" for name in present[1:])]
        rows = self._database.execute(f"SELECT {','.join(columns)} FROM topics ORDER BY id")  # noqa: S608 - constants
        topics = [dict(zip(present, row, strict=True)) for row in rows]
        invalid = [topic for topic in topics if not isinstance(topic["id"], int)]
        if invalid:
            reason = f"{len(invalid)} rows of the table `topics` have no integer id"
            self.unreadable.append(UnreadableRange(0, reason))
        by_id = {topic["id"]: topic for topic in topics if isinstance(topic["id"], int)}
        counts = self._counts if self._source is None else None
        return tuple(_connection(topic, counts, definitions) for topic in by_id.values())

    def _read_definitions(self) -> dict[str, Embedded]:
        if not self._columns.has_definitions:
            return {}
        columns = ("topic_type", "encoding", "encoded_message_definition")
        query = f"SELECT {','.join(f'CAST({name} AS BLOB)' for name in columns)} FROM message_definitions ORDER BY id DESC"  # noqa: S608 - constants
        return {
            _text(name): Embedded(_text(encoding), _text(text))
            for name, encoding, text in self._database.execute(query)
        }

    def _read_time_bounds(self) -> tuple[int | None, int | None]:
        try:
            first, last = self._database.execute(
                "SELECT (SELECT min(timestamp) FROM messages), (SELECT max(timestamp) FROM messages)"
            ).fetchone()
        except DAMAGE as err:
            self.notes.append(f"the first and last timestamps cannot be read: {err}")
            return None, None
        if not isinstance(first, int) or not isinstance(last, int):
            if first is not None or last is not None:
                self.notes.append("the first or last timestamp is not an integer")
            return None, None
        return first, last


class RowScan:
    """Reads the table of messages by row id and steps over rows that cannot be read.

    Rows of a damaged table may be out of order or repeated.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self.gaps: list[UnreadableRange] = []
        """The rows that SQLite failed to read."""
        self.rowids: set[int] = set()
        """Row ids of the rows read so far."""

    def rows(self) -> Iterator[Row]:
        """Yield every row that can be read."""
        position = 0
        while True:
            try:
                for row in self._select(position):
                    position = max(position, int(row[0]) + 1)
                    self.rowids.add(row[0])
                    yield row
            except DAMAGE as err:  # noqa: PERF203 - every part of the table may be damaged
                following = self._next_readable(position)
                end = "the end" if following is None else f"row {following[0]}"
                if following is None or following[0] > position:
                    self.gaps.append(UnreadableRange(position, f"{err}: rows are missing before {end}"))
                if following is None:
                    return
                self.rowids.add(following[0])
                # A query for this row and its successor could fail for both, so yield the row individually.
                yield following
                position = int(following[0]) + 1
            else:
                return

    def _select(self, rowid: int, limit: int = -1) -> Iterator[Row]:
        query = (
            "SELECT rowid, topic_id, timestamp, data FROM messages NOT INDEXED "
            "WHERE rowid >= ? ORDER BY rowid LIMIT ?"
        )
        yield from self._database.execute(query, (rowid, limit))

    def _next_readable(self, damaged: int) -> Row | None:
        """Return the first readable row from `damaged` on, None if there is none: an exponential, then binary search."""
        step, low, high = 1, damaged - 1, damaged
        while not self._is_readable(high):
            low, high, step = high, high + step, step * 2
            if high > _MAX_ROWID:
                return None
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if self._is_readable(middle) else (middle, high)
        row = next(self._select(high, 1), None)
        return row if row is not None and row[0] >= damaged else None

    def _is_readable(self, rowid: int) -> bool:
        try:
            list(self._select(rowid, 1))
        except DAMAGE:
            return False
        return True


class _RowSet:
    """The row ids that have been read, and the number of rows by topic."""

    def __init__(self, first: int, last: int) -> None:
        self._first = first
        size = last - first + 1
        self._bitmap = np.zeros(max(size, 0) if size <= _MAX_BITMAP_ROWS else 0, np.bool_)
        self._others: set[int] = set()
        """Row ids outside the bitmap."""
        self.by_topic: Counter[Any] = Counter()

    def add(self, page: list[Row]) -> list[Row]:
        """Add the rows of a page; return the new ones."""
        positions = np.fromiter((row[0] for row in page), np.int64, len(page)) - self._first
        is_inside = bool((positions >= 0).all()) and bool((positions < len(self._bitmap)).all())
        if is_inside and not self._bitmap[positions].any() and len(np.unique(positions)) == len(page):
            self._bitmap[positions] = True
            rows = page
        else:
            rows = [row for row in page if self._add_one(int(row[0]))]
        self.by_topic.update([row[1] for row in rows])
        return rows

    def _add_one(self, rowid: int) -> bool:
        """Add a row id; return whether it was not in the set."""
        position = rowid - self._first
        if 0 <= position < len(self._bitmap):
            is_new = not self._bitmap[position]
            self._bitmap[position] = True
            return is_new
        is_new = rowid not in self._others
        self._others.add(rowid)
        return is_new


class _Columns(Struct, frozen=True):
    """The columns and tables of a file; rosbag2 has added some over the years."""

    topics: frozenset[str]
    has_definitions: bool


class _Totals(Struct, frozen=True):
    """The number of messages according to the table, its index and its row ids, and the damage that they reveal."""

    by_topic: dict[int, int]
    table_rows: int | None
    untyped_rows: int
    """Rows whose topic id is not an integer."""
    index_rows: int | None
    first_rowid: int
    last_rowid: int
    damage: str | None

    @property
    def rowid_range(self) -> int:
        """The number of rows if no row was deleted."""
        return self.last_rowid - self.first_rowid + 1


def _read_totals(database: Database) -> _Totals:
    """Count the messages in three ways, and check the file if the results differ."""
    damage: str | None = None
    by_topic: dict[Any, int] = {}
    table_rows = index_rows = None
    first_rowid, last_rowid = 0, -1
    try:
        query = "SELECT topic_id, count(*) FROM messages NOT INDEXED GROUP BY topic_id"
        by_topic = dict(database.execute(query))
        table_rows = sum(by_topic.values())
        (index_rows,) = database.execute("SELECT count(*) FROM messages").fetchone()
        if table_rows or index_rows:
            first_rowid, last_rowid = _read_rowid_bounds(database)
    except (*DAMAGE, TypeError, ValueError) as err:
        damage = f"the messages cannot be counted: {err}"
    else:
        if not table_rows == index_rows == last_rowid - first_rowid + 1:
            damage = _check(database, "quick_check")
        if damage is None and table_rows != index_rows:
            damage = f"the table has {table_rows} rows, its index {index_rows}"
    typed = {key: count for key, count in by_topic.items() if isinstance(key, int)}
    untyped_rows = sum(by_topic.values()) - sum(typed.values())
    return _Totals(typed, table_rows, untyped_rows, index_rows, first_rowid, last_rowid, damage)


def _read_rowid_bounds(database: Database) -> tuple[int, int]:
    query = "SELECT (SELECT min(rowid) FROM messages), (SELECT max(rowid) FROM messages)"
    first, last = database.execute(query).fetchone()
    return int(first), int(last)


def _check(database: Database, check: str) -> str | None:
    """Return the first problem that `quick_check` or `integrity_check` finds in the file, None if it finds none."""
    try:
        (result,) = database.execute(f"PRAGMA {check}(1)").fetchone()
    except DAMAGE as err:
        return str(err)
    return None if result == "ok" else " ".join(str(result).replace("*", " ").split())


def _open_database(path: Path, stack: ExitStack, notes: list[str]) -> sqlite3.Connection:
    """Open a file read-only; open a copy if a log must be replayed or if the last page is incomplete."""
    logs = [log for suffix in ("-wal", "-journal") if _has_bytes(log := Path(f"{path}{suffix}"))]
    size = path.stat().st_size
    with path.open("rb") as file:
        page_bytes = _complete_pages(file.read(_HEAD_BYTES), size)
    if logs or page_bytes < size:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mosaico-")))
        for file in (path, *logs):
            shutil.copyfile(file, folder / file.name)
        path = folder / path.name
        os.truncate(path, page_bytes)
    if logs:
        notes.append(f"{logs[0].name} holds changes; they were replayed on a copy")
    uri = f"{path.absolute().as_uri()}?{'mode=rw' if logs else 'mode=ro&immutable=1'}"
    database = sqlite3.connect(uri, uri=True, check_same_thread=False)
    stack.callback(database.close)
    database.text_factory = _text
    return database


def _open_by_range(source: CachedSource, stack: ExitStack) -> Database:
    from mosaico_ingest.rosbag.remote_sqlite import RemoteDatabase  # noqa: PLC0415 - an optional dependency

    stack.callback(source.close)
    return RemoteDatabase(source, stack, size=_complete_pages(source.read_some(0, _HEAD_BYTES), source.size))


def _complete_pages(head: bytes, size: int) -> int:
    """Return the size of the complete pages in bytes: SQLite would read missing bytes of the last page as zeros."""
    page_bytes = int.from_bytes(head[16:18], "big")
    page_bytes = 1 << 16 if page_bytes == 1 else page_bytes
    return size - size % page_bytes if page_bytes else size


def _has_bytes(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > 0


def _text(value: object) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _read_tables(database: Database) -> set[str]:
    """Return the names of the tables, also of a truncated file."""
    query = "SELECT name FROM sqlite_master WHERE type = 'table'"
    try:
        return {str(name) for (name,) in database.execute(query)}
    except DAMAGE:
        # With this setting, SQLite opens files that are shorter than their header states. The file is read-only.
        database.execute("PRAGMA writable_schema = ON")
        return {str(name) for (name,) in database.execute(query)}


def _read_columns(database: Database) -> _Columns:
    tables = _read_tables(database)
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


def _connection(
    topic: dict[str, Any], counts: dict[int, int] | None, definitions: dict[str, Embedded]
) -> SplitConnection:
    encoding, msgtype = _text(topic.get("serialization_format", "cdr")), _text(topic["type"])
    attributes = {"encoding": encoding}
    for name in ("offered_qos_profiles", "type_description_hash"):
        if topic.get(name):
            attributes[name] = _text(topic[name])
    return SplitConnection(
        topic["id"],
        _text(topic["name"]),
        msgtype,
        Encoding.CDR if encoding == "cdr" else Encoding.OTHER,
        2,
        definitions.get(msgtype) or definitions.get(msgtype.removesuffix(_EVENT)),
        None if counts is None else counts.get(topic["id"], 0),
        attributes=attributes,
    )


def _query(request: ReadRequest) -> str:
    return (
        "SELECT rowid, topic_id, timestamp, data FROM messages "  # noqa: S608 - the keys are numbers
        f"WHERE {_of(request.connections)} AND timestamp BETWEEN ? AND ? ORDER BY timestamp"
    )


def _of(connections: Collection[int]) -> str:
    """Return the condition that selects the messages of some connections."""
    return f"topic_id IN ({','.join(str(int(key)) for key in connections)})"


def _is_unlimited(request: ReadRequest) -> bool:
    return request.start_ns <= EARLIEST_NS and request.end_ns > LATEST_NS


def _is_requested(row: Row, request: ReadRequest) -> bool:
    """Return whether a row belongs to the request; a row without a valid timestamp belongs to every time range."""
    if not isinstance(row[1], int) or row[1] not in request.connections:
        return False
    return not isinstance(row[2], int) or request.start_ns <= row[2] < request.end_ns


def _pages(
    rows: Iterator[Row], request: ReadRequest, *, max_rows: int = _MAX_PAGE_ROWS
) -> Iterator[list[Row]]:
    """Yield lists of rows of about the requested size."""
    return group_by_bytes(rows, _payload_bytes, request.block_bytes, max_length=max_rows)


def _payload_bytes(row: Row) -> int:
    return len(row[3]) if isinstance(row[3], bytes) else 0


def _first_time(rows: Sequence[Row], *, default: int) -> int:
    """Return the timestamp of the first row that has one."""
    return next((row[2] for row in rows if isinstance(row[2], int)), default)


def _load(rows: list[Row]) -> ReadResult:
    """Return the rows of a page by topic; rows with values of the wrong types are unreadable."""
    valid = [row for row in rows if [type(value) for value in row] == _ROW_TYPES]
    unreadable: list[UnreadableRange] = []
    if len(valid) < len(rows):
        reason = "a row whose values have the wrong types"
        unreadable = [
            UnreadableRange(row[0], reason, connection=row[1], count=1)
            for row in rows
            if [type(value) for value in row] != _ROW_TYPES
        ]
    if not valid:
        return ReadResult([], unreadable)
    ids, topics, times, payloads = zip(*valid, strict=True)
    lengths = np.fromiter(map(len, payloads), np.int64, len(payloads))
    block = MessageBlock(
        -1,
        np.array(times, np.int64),
        np.frombuffer(b"".join(payloads), np.uint8),
        np.cumsum(lengths) - lengths,
        lengths,
        np.array(ids, np.int64),
    )
    topic_ids = np.array(topics, np.int64)
    blocks = [block.rows(rows, connection=key) for key, rows in rows_by_connection(topic_ids)]
    return ReadResult(blocks, unreadable)
