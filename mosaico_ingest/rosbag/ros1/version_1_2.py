"""The reader of ROS 1 bags, version 1.2, which ROS wrote until 2010: a sequence of records without chunks.

The reader ignores the index of such bags: it lists messages only, and every record describes itself.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from functools import partial

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.containers import ROSRECORD
from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.blocks import (
    Encoding,
    Int64s,
    MessageBlock,
    ReadRequest,
    ReadResult,
    ReadTask,
    SplitConnection,
    UnreadableRange,
    add_selected_rows,
    rows_by_connection,
)
from mosaico_ingest.rosbag.definitions.model import Embedded
from mosaico_ingest.rosbag.ros1.index import Header, Record, find_message, number, record_at
from mosaico_ingest.rosbag.source import Source, Window

_DEFINITION, _MESSAGE, _FILE = 1, 2, 3
_RUN_BYTES = 4 << 20
"""Bytes of the file per read."""


class _ConnectionKey(Struct, frozen=True):
    """The fields of a message record that identify its connection."""

    topic: str
    msgtype: str
    md5sum: str


class _Run(Struct, frozen=True):
    """Consecutive messages that are read together; shapes (n,)."""

    connections: Int64s
    times: Int64s
    offsets: Int64s
    """File offsets of the records."""
    starts: Int64s
    ends: Int64s
    """File offsets of start and end of the payloads."""


class RosrecordReader:
    """The reader of one `.bag` file of version 1.2, which may lack its index or its end."""

    container = "ros1"

    def __init__(self, source: Source, _max_chunk_bytes: int = 0) -> None:  # the format has no chunks
        self.path = source.path
        self._source = source
        self.notes: list[str] = source.notes
        try:
            walk = _Walk(source)
            walk.run()
        except BaseException:
            source.close()
            raise
        self.notes.append(
            "a bag of version 1.2, read record by record; `rosbag fix` converts it to version 2.0"
        )
        self.unreadable: list[UnreadableRange] = walk.unreadable
        messages = np.frombuffer(walk.messages, np.int64).reshape(-1, 5)
        self._runs = sorted(_runs(messages), key=lambda run: int(run.times.min()))
        counts = np.bincount(messages[:, 0], minlength=len(walk.ids))
        self.connections: tuple[SplitConnection, ...] = walk.connections(counts)
        self.message_count: int | None = len(messages)
        self.start_ns: int | None = int(messages[:, 1].min()) if len(messages) else None
        self.end_ns: int | None = int(messages[:, 1].max()) if len(messages) else None

    def read_tasks(self, request: ReadRequest) -> Iterator[ReadTask]:
        """Yield tasks for the ranges of the file that contain requested messages."""
        keys = np.array(list(request.connections), np.int64)
        for run in self._runs:
            first, last = int(run.times.min()), int(run.times.max())
            if request.overlaps(first, last) and np.isin(run.connections, keys).any():
                yield ReadTask(first, partial(self._load, run, request))

    def check_unchanged(self) -> None:
        """See `Source.check_unchanged`."""
        self._source.check_unchanged()

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    def _load(self, run: _Run, request: ReadRequest) -> ReadResult:
        result = ReadResult([], [])
        requested = [
            (key, rows) for key, rows in rows_by_connection(run.connections) if key in request.connections
        ]
        start = int(run.offsets[0])
        try:
            data = self._source.read(start, int(run.ends[-1]) - start)
        except BagError as err:
            result.unreadable.extend(
                UnreadableRange(start, err.what, connection=key, count=len(rows)) for key, rows in requested
            )
            return result
        lengths = run.ends - run.starts
        buffer = np.frombuffer(data, np.uint8)
        block = MessageBlock(-1, run.times, buffer, run.starts - start, lengths, run.offsets)
        add_selected_rows(block, requested, request, result)
        return result


def _runs(messages: Int64s) -> Iterator[_Run]:
    """Split the messages, in file order, into runs of about `_RUN_BYTES`."""
    connections, times, offsets, starts, ends = np.ascontiguousarray(messages.T)
    first = 0
    while first < len(messages):
        last = max(int(np.searchsorted(ends, offsets[first] + _RUN_BYTES, side="right")), first + 1)
        rows = slice(first, last)
        yield _Run(connections[rows], times[rows], offsets[rows], starts[rows], ends[rows])
        first = last


class _Walk:
    """Visits record after record and collects messages and definitions."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self.ids: dict[_ConnectionKey, int] = {}
        self._ids_of_fields: dict[tuple[bytes | None, ...], int] = {}
        """Caches ids by the undecoded fields."""
        self._definitions: dict[_ConnectionKey, str] = {}
        self._latched = set[int]()
        self._index_at: int | None = None
        self.messages = array("q")
        """Connection, log time, offset of the record, start and end of the payload of each message."""
        self.unreadable: list[UnreadableRange] = []

    def run(self) -> None:
        """Visit every record; after an invalid record, continue with the next message."""
        source, stop = self._source, self._source.size
        source.fetch_whole()
        window = Window(source)
        line = window.peek(0, len(ROSRECORD) + 2)
        position = len(line) - len(line[len(ROSRECORD) :].lstrip(b"\r\n"))
        while position < stop:
            position = self._step(window, position, stop)
        if self._index_at == 0:
            self.unreadable.append(UnreadableRange(stop, "the bag was not closed", count=0))
        elif self._index_at and self._index_at >= stop:
            reason = f"the file is truncated: its index would start at {self._index_at}"
            self.unreadable.append(UnreadableRange(stop, reason))

    def _step(self, window: Window, position: int, stop: int) -> int:
        try:
            record = record_at(window, position, stop)
            self._add_record(record)
        except BagError as err:
            resume_at = find_message(self._source, position + 1, stop) or stop
            reason = f"{err.what}; {resume_at - position} bytes are not read"
            self.unreadable.append(UnreadableRange(position, reason))
            return resume_at
        return record.end

    def _add_record(self, record: Record) -> None:
        if record.op == _DEFINITION:
            self._definitions.setdefault(_key(record.header), _text(record.header, b"def"))
        elif record.op == _FILE:
            self._index_at = number(record.header, b"index_pos", 8)
        elif record.op == _MESSAGE:
            seconds, nanoseconds = number(record.header, b"sec", 4), number(record.header, b"nsec", 4)
            connection = self._connection_id(record.header)
            if record.header.get(b"latching") in {b"1", b"\1"}:
                self._latched.add(connection)
            time_ns = seconds * 1_000_000_000 + nanoseconds
            self.messages.extend((connection, time_ns, record.offset, record.start, record.end))

    def _connection_id(self, header: Header) -> int:
        fields = header.get(b"topic"), header.get(b"type"), header.get(b"md5")
        connection = self._ids_of_fields.get(fields)
        if connection is None:
            connection = self.ids.setdefault(_key(header), len(self.ids))
            self._ids_of_fields[fields] = connection
        return connection

    def connections(self, counts: NDArray[np.intp]) -> tuple[SplitConnection, ...]:
        """Return the connections; without a definition of its own, one uses that of another topic of its type."""
        by_type = {(key.msgtype, key.md5sum): text for key, text in self._definitions.items()}
        return tuple(
            SplitConnection(
                number,
                key.topic,
                key.msgtype,
                Encoding.ROS1,
                1,
                None if text is None else Embedded("ros1msg", text),
                int(counts[number]),
                latched=number in self._latched,
                attributes={"encoding": "ros1", "md5sum": key.md5sum},
            )
            for key, number in self.ids.items()
            for text in [self._definitions.get(key, by_type.get((key.msgtype, key.md5sum)))]
        )


def _key(header: Header) -> _ConnectionKey:
    return _ConnectionKey(_text(header, b"topic"), _text(header, b"type"), _text(header, b"md5"))


def _text(header: Header, name: bytes) -> str:
    if name not in header:
        raise BagError(f"a record without {name.decode()}")
    return header[name].decode("utf-8", "replace")
