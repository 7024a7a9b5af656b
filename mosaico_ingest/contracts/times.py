"""Log times of topics: streaming accumulators, the order in the files, and the windows in which the recorder did not record.

Times arrive in batches, in order. Every accumulator carries the state across batches that makes its result independent
of the size of the batches.

The known events are those of rosbag2_dynamic_recorder: `PauseEvent` with an `action` (0 paused, 1 resumed), and
`SubscriptionChangeEvent` with a `topic` and an `action` (0 subscribed, 1 unsubscribed). Types of other packages with the
same names and fields count, too.
"""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from msgspec import Struct, field
from numpy.typing import NDArray

from mosaico_ingest.contracts.values import differences, missing_between
from mosaico_ingest.job.values import Interval
from mosaico_ingest.rosbag.blocks import LATEST_NS, Connection, Encoding, Int64s, MessageBlock, fixed_slices
from mosaico_ingest.rosbag.recording import Recording

PERIOD_SAMPLE = 1000
"""Number of first intervals whose median is a topic's period."""
_NONE = np.zeros(0, np.int64)


_SEQUENCE_AT = 20
"""Bytes from the sequence number of an MCAP message record to its payload."""
_PAUSE, _SUBSCRIPTION = "PauseEvent", "SubscriptionChangeEvent"
_FIELDS = {_PAUSE: {"action"}, _SUBSCRIPTION: {"action", "topic"}}
_STARTS = {_PAUSE: 0, _SUBSCRIPTION: 1}
"""The action that starts a window without messages; the other action ends it."""
Windows = NDArray[np.int64]
"""Start and end of each window in nanoseconds since the epoch, sorted and disjoint, shape (n, 2)."""
NO_WINDOWS: Windows = np.zeros((0, 2), np.int64)


class Gap(Struct, frozen=True):
    """An interval between two consecutive messages."""

    start_ns: int
    end_ns: int
    index: int
    """Position on the topic of the message that ends the interval."""

    @property
    def length_ns(self) -> int:
        """The length in nanoseconds."""
        return self.end_ns - self.start_ns


class Gaps(Struct):
    """The intervals that are longer than a limit."""

    over: Interval
    lengths: Int64s = _NONE
    """Length of each long interval in nanoseconds, shape (n,)."""
    ends: Int64s = _NONE
    """Log time of the message that ends each long interval, shape (n,)."""
    indexes: Int64s = _NONE
    """Position on the topic of the message that ends each long interval, shape (n,)."""
    total: int = 0
    """Number of intervals."""
    limit_ns: int | None = None
    """The limit in nanoseconds; None while a multiple of the period is unknown."""
    _pending: list[tuple[Int64s, Int64s, int]] = field(default_factory=list[tuple[Int64s, Int64s, int]])
    """Intervals, end times and first index of the batches before the period is known."""
    _found: list[tuple[Int64s, Int64s, Int64s]] = field(default_factory=list[tuple[Int64s, Int64s, Int64s]])

    def __post_init__(self) -> None:
        self.limit_ns = self.over.ns

    def add(self, intervals: Int64s, ends: Int64s, index: int, longest_ns: int) -> None:
        """Add intervals; `index` is the position of the message that ends the first one, `longest_ns` their maximum."""
        self.total += len(intervals)
        if self.limit_ns is None:
            self._pending.append((intervals, ends, index))
            if self.total >= PERIOD_SAMPLE:
                self._resolve()
        elif longest_ns > self.limit_ns:
            self._select(intervals, ends, index)

    def finish(self) -> None:
        """Complete the arrays after the last batch."""
        if self.limit_ns is None and self.total:
            self._resolve()
        if self._found:
            lengths, ends, indexes = zip(*self._found, strict=True)
            self.lengths, self.ends, self.indexes = map(np.concatenate, (lengths, ends, indexes))
            self._found = []

    def at(self, position: int) -> Gap:
        """Return one of the long intervals."""
        end = int(self.ends[position])
        return Gap(end - int(self.lengths[position]), end, int(self.indexes[position]))

    def _resolve(self) -> None:
        sample = np.concatenate([intervals for intervals, _, _ in self._pending])[:PERIOD_SAMPLE]
        self.limit_ns = int((self.over.periods or 0) * float(np.median(sample)))
        pending, self._pending = self._pending, []
        for intervals, ends, index in pending:
            self._select(intervals, ends, index)

    def _select(self, intervals: Int64s, ends: Int64s, index: int) -> None:
        positions = np.flatnonzero(intervals > (self.limit_ns or 0))
        if len(positions):
            self._found.append((intervals[positions], ends[positions], positions + index))


class WindowExtreme(Struct, frozen=True):
    """The window with the lowest or highest count."""

    count: int
    start_ns: int
    index: int
    """Position on the topic of the message at which the window starts."""


class SlidingWindow(Struct):
    """The lowest and the highest number of messages in windows of one length.

    For the highest number, a window starts with a message; for the lowest number, it starts right after a message and
    ends within the topic's time span. The count of a periodic topic is the same in both.
    """

    length_ns: int
    min_count: float = -np.inf
    """Windows with fewer messages are violations."""
    max_count: float = np.inf
    """Windows with more messages are violations."""
    lowest: WindowExtreme | None = None
    highest: WindowExtreme | None = None
    violations: int = 0
    first: WindowExtreme | None = None
    _times: Int64s = _NONE
    """Log times from the first message whose window may not be complete."""
    _index: int = 0
    """Position on the topic of the first of `_times`."""

    def add(self, times: Int64s) -> None:
        """Add log times in order."""
        self._times = np.concatenate([self._times, times])
        complete = int(np.searchsorted(self._times, self._times[-1] - self.length_ns, "left"))
        if complete:
            self._count(complete, complete)

    def finish(self) -> None:
        """Count the windows of the last messages."""
        if len(self._times):
            inside = int(np.searchsorted(self._times, self._times[-1] - self.length_ns, "right"))
            self._count(len(self._times), inside)

    def _count(self, starts: int, inside: int) -> None:
        """Count the windows of the first `starts` messages; only `inside` of them end within the time span."""
        times, begins = self._times, self._times[:starts]
        most = np.searchsorted(times, begins + self.length_ns, "left") - np.searchsorted(
            times, begins, "left"
        )
        self._note(most, most > self.max_count, highest=True)
        if inside:
            first_after = np.searchsorted(times, begins[:inside], "right")
            least = np.searchsorted(times, begins[:inside] + self.length_ns, "right") - first_after
            self._note(least, least < self.min_count, highest=False)
        self._times = times[starts:]
        self._index += starts

    def _note(self, counts: NDArray[np.intp], is_bad: NDArray[np.bool_], *, highest: bool) -> None:
        position = int(counts.argmax() if highest else counts.argmin())
        extreme = self._extreme(counts, position)
        record = self.highest if highest else self.lowest
        if record is None or (extreme.count > record.count if highest else extreme.count < record.count):
            if highest:
                self.highest = extreme
            else:
                self.lowest = extreme
        if is_bad.any():
            self.violations += int(is_bad.sum())
            first = self._extreme(counts, int(is_bad.argmax()))
            if self.first is None or first.start_ns < self.first.start_ns:
                self.first = first

    def _extreme(self, counts: NDArray[np.intp], position: int) -> WindowExtreme:
        return WindowExtreme(int(counts[position]), int(self._times[position]), self._index + position)


class TopicTimes(Struct):
    """The log times of one topic: count, span, longest interval, and the accumulators of its expectations."""

    gaps: dict[str, Gaps] = field(default_factory=dict[str, Gaps])
    """By the key of the expectation."""
    windows: dict[str, SlidingWindow] = field(default_factory=dict[str, SlidingWindow])
    count: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    longest: Gap | None = None
    late: int = 0
    """Number of batches that start before the end of the batch before them: gaps and windows are unknown then."""
    _previous: int | None = None

    @property
    def span_ns(self) -> int:
        """The time between the first and the last message."""
        return 0 if self.first_ns is None or self.last_ns is None else self.last_ns - self.first_ns

    def add(self, times: Int64s) -> None:
        """Add the log times of a batch, which are sorted."""
        if not len(times):
            return
        first, last = int(times[0]), int(times[-1])
        self.first_ns = first if self.first_ns is None else min(self.first_ns, first)
        self.last_ns = last if self.last_ns is None else max(self.last_ns, last)
        index = self.count
        self.count += len(times)
        if self._previous is not None and first < self._previous:
            self.late += 1
        if not self.late:
            self._add_intervals(times, index)
            for window in self.windows.values():
                window.add(times)
        self._previous = last

    def finish(self) -> None:
        """Complete the accumulators after the last batch."""
        for gaps in self.gaps.values():
            gaps.finish()
        for window in self.windows.values():
            window.finish()

    def _add_intervals(self, times: Int64s, index: int) -> None:
        steps = differences(times, self._previous)
        if self._previous is None:
            ends, intervals, index = times[1:], steps[1:], index + 1
        else:
            ends, intervals = times, steps
        if not len(intervals):
            return
        position = int(intervals.argmax())
        length = int(intervals[position])
        if self.longest is None or length > self.longest.length_ns:
            end = int(ends[position])
            self.longest = Gap(end - length, end, index + position)
        for gaps in self.gaps.values():
            gaps.add(intervals, ends, index, length)


class FileStep(Struct, frozen=True):
    """A step of the log times or sequence numbers between two messages that are consecutive in a file."""

    size: int
    """Nanoseconds of a step back, or number of missing sequence numbers."""
    log_time_ns: int
    """Log time of the second message."""


class FileSteps(Struct, frozen=True):
    """The steps that violate the order: their number, their sum, the first one and the largest one."""

    count: int = 0
    total: int = 0
    first: FileStep | None = None
    worst: FileStep | None = None

    def __add__(self, later: FileSteps) -> FileSteps:
        """Return both, in the order of the file."""
        steps = [step for step in (self.worst, later.worst) if step is not None]
        worst = max(steps, key=lambda step: step.size, default=None)
        return FileSteps(self.count + later.count, self.total + later.total, self.first or later.first, worst)


class _Piece(Struct, frozen=True):
    """Messages of one connection that are consecutive in a file."""

    split: int
    offset: int
    times: tuple[int, int]
    """First and last log time, in the order of the file."""
    numbers: tuple[int, int]
    """First and last sequence number."""
    back: FileSteps
    missing: FileSteps
    any_number: bool
    """Whether a sequence number is not zero."""


class _Records(Struct, frozen=True):
    """Messages of one connection: their position in the file, log times and sequence numbers, shape (n,)."""

    split: int
    offsets: Int64s
    times: Int64s
    numbers: Int64s


class FileOrder:
    """Observes the messages of some connections before they are sorted by time.

    Several threads may add messages, and the chunks of a file may be read in any order. Each chunk is reduced to its own result, and the results are joined in
    the order of the file. Messages outside chunks are kept until the end, with 24 bytes for each.
    """

    def __init__(self, *, has_numbers: bool) -> None:
        self._has_numbers = has_numbers
        self._lock = threading.Lock()
        self._pieces: dict[int, list[_Piece]] = defaultdict(list)
        self._records: dict[int, list[_Records]] = defaultdict(list)

    def add(self, split: int, connection: int, block: MessageBlock) -> None:
        """Add messages that were read together, over the buffer that holds their records."""
        order = np.lexsort((block.starts, block.offsets))
        offsets, times, starts = block.offsets[order], block.log_times[order], block.starts[order]
        numbers = np.zeros(len(times), np.int64)
        if self._has_numbers and int(starts.min()) >= _SEQUENCE_AT:
            words = fixed_slices(block.data, starts - _SEQUENCE_AT, 4)
            numbers = words.view("<u4").reshape(-1).astype(np.int64)
        edges = (np.flatnonzero(np.diff(offsets)) + 1).tolist()
        if len(edges) == len(times) - 1:  # the offsets are those of messages, not of chunks
            with self._lock:
                self._records[connection].append(_Records(split, offsets, times, numbers))
            return
        pieces = [
            _piece(split, int(offsets[start]), times[start:end], numbers[start:end])
            for start, end in pairwise((0, *edges, len(times)))
        ]
        with self._lock:
            self._pieces[connection] += pieces

    def steps_back(self, connection: int) -> FileSteps:
        """Return the messages of a connection with an earlier log time than the message before them in the file."""
        pieces = self._in_file_order(connection)
        result = FileSteps()
        for position, piece in enumerate(pieces):
            before = pieces[position - 1] if position else None
            if before is not None and before.split == piece.split:
                result += _back(np.array([before.times[1], piece.times[0]], np.int64))
            result += piece.back
        return result

    def missing_numbers(self, connection: int) -> FileSteps | None:
        """Return the sequence numbers that no message of a connection has; None if its messages are not numbered."""
        pieces = self._in_file_order(connection)
        if not any(piece.any_number for piece in pieces):
            return None
        result = FileSteps()
        for position, piece in enumerate(pieces):
            if position:
                numbers = np.array([pieces[position - 1].numbers[1], piece.numbers[0]], np.int64)
                result += _missing(numbers, np.array(piece.times[:1] * 2, np.int64))
            result += piece.missing
        return result

    def _in_file_order(self, connection: int) -> list[_Piece]:
        pieces = self._pieces.get(connection, [])
        by_split: dict[int, list[_Records]] = defaultdict(list)
        for records in self._records.get(connection, ()):
            by_split[records.split].append(records)
        joined = [
            piece
            for split, records in by_split.items()
            for piece in _joined(records, [piece.offset for piece in pieces if piece.split == split])
        ]
        return sorted([*pieces, *joined], key=lambda piece: (piece.split, piece.offset))


def _joined(records: list[_Records], cuts: list[int]) -> Iterator[_Piece]:
    """Yield the records of a split as pieces, which end where the pieces at the offsets `cuts` start."""
    offsets = np.concatenate([part.offsets for part in records])
    order = np.argsort(offsets, kind="stable")
    offsets = offsets[order]
    times = np.concatenate([part.times for part in records])[order]
    numbers = np.concatenate([part.numbers for part in records])[order]
    edges = sorted({0, *np.searchsorted(offsets, np.array(cuts, np.int64)).tolist(), len(offsets)})
    for start, end in pairwise(edges):
        yield _piece(records[0].split, int(offsets[start]), times[start:end], numbers[start:end])


def _piece(split: int, offset: int, times: Int64s, numbers: Int64s) -> _Piece:
    return _Piece(
        split,
        offset,
        (int(times[0]), int(times[-1])),
        (int(numbers[0]), int(numbers[-1])),
        _back(times),
        _missing(numbers, times),
        bool(numbers.any()),
    )


def _back(times: Int64s) -> FileSteps:
    return _steps(np.maximum(-np.diff(times), 0), times)


def _missing(numbers: Int64s, times: Int64s) -> FileSteps:
    return _steps(missing_between(np.diff(numbers)), times)


def _steps(sizes: NDArray[np.int64], times: Int64s) -> FileSteps:
    positions = np.flatnonzero(sizes)
    if not len(positions):
        return FileSteps()
    first, worst = int(positions[0]), int(sizes.argmax())
    return FileSteps(
        len(positions),
        int(sizes.sum()),
        FileStep(int(sizes[first]), int(times[first + 1])),
        FileStep(int(sizes[worst]), int(times[worst + 1])),
    )


class RecorderEvents(Struct, frozen=True):
    """The windows in which the recorder did not record."""

    paused: Windows = NO_WINDOWS
    by_topic: Mapping[str, Windows] = {}

    def windows_of(self, topic: str) -> Windows:
        """Return the windows in which a topic was not recorded."""
        own = self.by_topic.get(topic)
        return self.paused if own is None else _merged([*self.paused.tolist(), *own.tolist()])


def event_connections(connections: Iterable[Connection]) -> tuple[Connection, ...]:
    """Return the connections whose messages are events of the recorder."""
    return tuple(
        connection
        for connection in connections
        if connection.definition is not None
        and connection.encoding is not Encoding.OTHER
        and connection.count != 0
        and _FIELDS.get(_kind(connection), {""})
        <= {field.name for field in connection.definition.message.fields}
    )


def read_events(recording: Recording) -> RecorderEvents:
    """Read the events of the recorder; events that cannot be decoded are ignored."""
    connections = {connection.id: connection for connection in event_connections(recording.connections)}
    if not connections:
        return RecorderEvents()
    from mosaico_ingest.decode.decoder import decoder_for  # noqa: PLC0415 - few recordings have events

    decoders = {key: decoder_for(connection) for key, connection in connections.items()}
    events: list[tuple[int, str, str, bool]] = []
    for block in recording.message_blocks(tuple(connections)):
        decoded = decoders[block.connection].decode(block)
        kind = _kind(connections[block.connection])
        rows: Any = decoded.rows  # the stubs lack to_pylist of struct arrays
        for row, time in zip(rows.to_pylist(), block.log_times[decoded.index].tolist(), strict=True):
            topic = str(row["topic"]) if kind == _SUBSCRIPTION else ""
            events.append((time, kind, topic, int(row["action"]) == _STARTS[kind]))
    events.sort(key=lambda event: event[0])
    paused = _windows((time, starts) for time, kind, _, starts in events if kind == _PAUSE)
    topics = dict.fromkeys(topic for _, kind, topic, _ in events if kind == _SUBSCRIPTION)
    return RecorderEvents(
        paused,
        {
            name: _windows((time, starts) for time, _, topic, starts in events if topic == name)
            for name in topics
        },
    )


def uncovered_ns(starts: NDArray[np.int64], ends: NDArray[np.int64], windows: Windows) -> NDArray[np.int64]:
    """Return the longest part of each interval that no window covers, in nanoseconds, shape (n,)."""
    return np.array(
        [
            _longest_rest(start, end, windows)
            for start, end in zip(starts.tolist(), ends.tolist(), strict=True)
        ],
        np.int64,
    )


def covered_ns(start: int, end: int, windows: Windows) -> int:
    """Return the time of an interval that windows cover, in nanoseconds."""
    overlaps = np.minimum(windows[:, 1], end) - np.maximum(windows[:, 0], start)
    return int(overlaps[overlaps > 0].sum())


def _longest_rest(start: int, end: int, windows: Windows) -> int:
    inside = windows[(windows[:, 1] > start) & (windows[:, 0] < end)]
    rest, position = 0, start
    for window_start, window_end in inside.tolist():
        rest = max(rest, window_start - position)
        position = max(position, window_end)
    return max(rest, end - position)


def _kind(connection: Connection) -> str:
    return connection.msgtype.rpartition("/")[2]


def _windows(events: Iterable[tuple[int, bool]]) -> Windows:
    """Return the windows between events that start and end one; a window that never ends lasts forever."""
    windows: list[list[int]] = []
    start: int | None = None
    for time, starts in events:
        if starts and start is None:
            start = time
        elif not starts and start is not None:
            windows.append([start, time])
            start = None
    if start is not None:
        windows.append([start, LATEST_NS])
    return _merged(windows)


def _merged(windows: list[list[int]]) -> Windows:
    merged: list[list[int]] = []
    for start, end in sorted(windows):
        if merged and start <= merged[-1][1]:
            merged[-1][1] = max(merged[-1][1], end)
        else:
            merged.append([start, end])
    return np.array(merged, np.int64).reshape(-1, 2)
