"""The order of the messages in the files: log times that step back, and the sequence numbers of MCAP messages."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.contracts.values import missing_between
from mosaico_ingest.rosbag.blocks import Int64s, MessageBlock, fixed_slices

_SEQUENCE_AT = 20
"""Bytes from the sequence number of an MCAP message record to its payload."""


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
