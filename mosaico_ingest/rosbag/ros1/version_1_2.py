"""This file reads ROS bags of version 1.2, as ROS wrote them until 2010: records one after the other, without chunks.

Their index, where there is one, is not used: it names messages only, and every record says itself what it is.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from functools import partial

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.blocks import (
    Block,
    Encoding,
    Loaded,
    Slab,
    Stream,
    UnreadableRange,
    Want,
    by_key,
    keep_each,
)
from mosaico_ingest.rosbag.definitions.model import Embedded
from mosaico_ingest.rosbag.formats import ROSRECORD
from mosaico_ingest.rosbag.recovery import next_ros1_message
from mosaico_ingest.rosbag.ros1.records import (
    Header,
    Record,
    number,
    record_at,
)
from mosaico_ingest.rosbag.source import Source, Window

__all__ = ["RosrecordPart"]

_DEFINITION, _MESSAGE, _FILE = 1, 2, 3
_RUN_BYTES = 4 << 20
"""How much of the file is read at once."""


class _Name(Struct, frozen=True):
    """What a message says about itself; each is a stream of its own."""

    topic: str
    msgtype: str
    md5sum: str


class _Run(Struct, frozen=True):
    """Messages that are read at once: their streams, times, and where they and their payloads lie."""

    keys: NDArray[np.int64]
    times: NDArray[np.int64]
    ats: NDArray[np.int64]
    begins: NDArray[np.int64]
    ends: NDArray[np.int64]


class RosrecordPart:
    """One `.bag` file of version 1.2, closed properly or not."""

    container = "ros1"

    def __init__(self, source: Source) -> None:
        self.path = source.path
        self._source = source
        self.notes: list[str] = source.notes
        try:
            walk = _Walk(source)
            walk.over()
        except BaseException:
            source.close()
            raise
        self.notes.append("a bag of version 1.2, read record by record; `rosbag fix` makes it one of 2.0")
        self.unreadable: list[UnreadableRange] = walk.unreadable
        found = np.frombuffer(walk.messages, np.int64).reshape(-1, 5)
        self._runs = sorted(_runs(found), key=lambda run: int(run.times.min()))
        self.streams: tuple[Stream, ...] = walk.streams(np.bincount(found[:, 0], minlength=len(walk.keys)))
        self.message_count: int | None = len(found)
        self.start_ns: int | None = int(found[:, 1].min()) if len(found) else None
        self.end_ns: int | None = int(found[:, 1].max()) if len(found) else None

    def blocks(self, want: Want) -> Iterator[Block]:
        """Yield the stretches of the file that hold wanted messages."""
        keys = np.array(list(want.keys), np.int64)
        for run in self._runs:
            if want.overlaps(int(run.times.min()), int(run.times.max())) and np.isin(run.keys, keys).any():
                yield Block(int(run.times.min()), partial(self._load, run, want))

    def check_unchanged(self) -> None:
        """See `Source.check_unchanged`."""
        self._source.check_unchanged()

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    def _load(self, run: _Run, want: Want) -> Loaded:
        loaded = Loaded([], [])
        wanted = [(key, rows) for key, rows in by_key(run.keys) if key in want.keys]
        begin = int(run.ats[0])
        try:
            data = self._source.read(begin, int(run.ends[-1]) - begin)
        except BagError as err:
            loaded.unreadable.extend(
                UnreadableRange(begin, err.what, connection=key, count=len(rows)) for key, rows in wanted
            )
            return loaded
        lengths = run.ends - run.begins
        whole = Slab(-1, run.times, np.frombuffer(data, np.uint8), run.begins - begin, lengths, run.ats)
        keep_each(whole, wanted, want, loaded)
        return loaded


def _runs(found: NDArray[np.int64]) -> Iterator[_Run]:
    """Cut the messages, in their order in the file, into stretches of it."""
    keys, times, ats, begins, ends = np.ascontiguousarray(found.T)
    first = 0
    while first < len(found):
        last = max(int(np.searchsorted(ends, ats[first] + _RUN_BYTES, side="right")), first + 1)
        part = slice(first, last)
        yield _Run(keys[part], times[part], ats[part], begins[part], ends[part])
        first = last


class _Walk:
    """Goes from record to record and writes down what is there."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self.keys: dict[_Name, int] = {}
        self._known: dict[tuple[bytes | None, ...], int] = {}
        """The keys by what stands in the records, which need not be decoded for each."""
        self._texts: dict[_Name, str] = {}
        self._latched = set[int]()
        self._index_at: int | None = None
        self.messages = array("q")
        """Of each its stream, time, record, and where its payload begins and ends."""
        self.unreadable: list[UnreadableRange] = []

    def over(self) -> None:
        """Look at every record; where one does not fit, go on at the next message."""
        source, stop = self._source, self._source.size
        source.fetch_whole()
        window = Window(source)
        line = window.peek(0, len(ROSRECORD) + 2)
        at = len(line) - len(line[len(ROSRECORD) :].lstrip(b"\r\n"))
        while at < stop:
            at = self._step(window, at, stop)
        if self._index_at == 0:
            self.unreadable.append(UnreadableRange(stop, "the bag was not closed", count=0))
        elif self._index_at and self._index_at >= stop:
            self.unreadable.append(
                UnreadableRange(stop, f"cut off: its index would begin at {self._index_at}")
            )

    def _step(self, window: Window, at: int, stop: int) -> int:
        try:
            record = record_at(window, at, stop)
            self._record(record)
        except BagError as err:
            resumed = next_ros1_message(self._source, at + 1, stop) or stop
            self.unreadable.append(UnreadableRange(at, f"{err.what}; {resumed - at} bytes are not read"))
            return resumed
        return record.end

    def _record(self, record: Record) -> None:
        if record.op == _DEFINITION:
            self._texts.setdefault(_name(record.header), _text(record.header, b"def"))
        elif record.op == _FILE:
            self._index_at = number(record.header, b"index_pos", 8)
        elif record.op == _MESSAGE:
            seconds, rest = number(record.header, b"sec", 4), number(record.header, b"nsec", 4)
            key = self._key(record.header)
            if record.header.get(b"latching") in {b"1", b"\1"}:
                self._latched.add(key)
            time_ns = seconds * 1_000_000_000 + rest
            self.messages.extend((key, time_ns, record.at, record.begin, record.end))

    def _key(self, header: Header) -> int:
        raw = header.get(b"topic"), header.get(b"type"), header.get(b"md5")
        key = self._known.get(raw)
        if key is None:
            key = self._known[raw] = self.keys.setdefault(_name(header), len(self.keys))
        return key

    def streams(self, counts: NDArray[np.intp]) -> tuple[Stream, ...]:
        """Return the streams; a message without a definition of its topic has that of another of its type."""
        by_type = {(name.msgtype, name.md5sum): text for name, text in self._texts.items()}
        return tuple(
            Stream(
                key,
                name.topic,
                name.msgtype,
                Encoding.ROS1,
                1,
                None if text is None else Embedded("ros1msg", text),
                int(counts[key]),
                latched=key in self._latched,
                attributes={"encoding": "ros1", "md5sum": name.md5sum},
            )
            for name, key in self.keys.items()
            for text in [self._texts.get(name, by_type.get((name.msgtype, name.md5sum)))]
        )


def _name(header: Header) -> _Name:
    return _Name(_text(header, b"topic"), _text(header, b"type"), _text(header, b"md5"))


def _text(header: Header, name: bytes) -> str:
    if name not in header:
        raise BagError(f"a record without {name.decode()}")
    return header[name].decode("utf-8", "replace")
