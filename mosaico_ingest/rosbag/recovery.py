"""Resynchronization: find the next chunk or message after bytes that are not valid records."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator

import numpy as np
from msgspec import Struct

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.mcap import records as mcap_records
from mosaico_ingest.rosbag.ros1 import records as ros1_records
from mosaico_ingest.rosbag.source import Source, Window

_STEP_BYTES = 1 << 20
_OVERLAP_BYTES = 1 << 10
"""Overlap of two steps; more than any pattern spans."""
_MCAP_HEAD_BYTES = 256
"""Bytes to read for the head of an MCAP chunk record; more than it can take."""


class _Ros1Kind(Struct, frozen=True):
    """The features by which a kind of ROS 1 record is recognized."""

    op: int
    fields: frozenset[bytes]
    max_before: int
    """Maximum distance from the start of the header to its field `op=`, in bytes."""


_ROS1_CHUNK = _Ros1Kind(ros1_records.Op.CHUNK, frozenset({b"compression", b"size"}), 128)
_ROS1_MESSAGE = _Ros1Kind(
    ros1_records.Op.MESSAGE, frozenset({b"topic", b"type", b"md5", b"sec", b"nsec"}), 512
)


def find_mcap_chunk(source: Source, start: int, stop: int) -> int | None:
    """Return the offset of the next complete MCAP chunk between `start` and `stop`, None if there is none."""

    def is_chunk(offset: int) -> bool:
        data = source.read_some(offset, _MCAP_HEAD_BYTES)
        try:
            head = mcap_records.chunk_head(data)
        except BagError:
            return False
        _, length = mcap_records.RECORD.unpack_from(data)
        end = mcap_records.RECORD.size + length
        return head.end == end and offset + end <= stop and head.compression in {"", "zstd", "lz4"}

    return _search(source, start, stop, _mcap_candidates, is_chunk)


def find_ros1_chunk(source: Source, start: int, stop: int) -> int | None:
    """Return the offset of the next complete chunk of a ROS 1 bag, None if there is none."""
    return _search(source, start, stop, _ros1_candidates(_ROS1_CHUNK), _is_ros1(source, stop, _ROS1_CHUNK))


def find_ros1_message(source: Source, start: int, stop: int) -> int | None:
    """Return the offset of the next complete message of a bag of version 1.2, None if there is none."""
    return _search(
        source, start, stop, _ros1_candidates(_ROS1_MESSAGE), _is_ros1(source, stop, _ROS1_MESSAGE)
    )


def _is_ros1(source: Source, stop: int, kind: _Ros1Kind) -> Callable[[int], bool]:
    """Return a predicate: whether a complete record of the kind starts at an offset."""
    window = Window(source)

    def is_record(offset: int) -> bool:
        try:
            record = ros1_records.record_at(window, offset, stop)
        except BagError:
            return False
        return record.op == kind.op and kind.fields <= record.header.keys()

    return is_record


def _search(
    source: Source,
    start: int,
    stop: int,
    candidates: Callable[[bytes], Iterator[int]],
    is_record: Callable[[int], bool],
) -> int | None:
    while start < stop:
        data = source.read_some(start, min(_STEP_BYTES, stop - start))
        for candidate in candidates(data):
            if is_record(start + candidate):
                return start + candidate
        if len(data) < _STEP_BYTES:
            return None
        start += _STEP_BYTES - _OVERLAP_BYTES
    return None


def _mcap_candidates(data: bytes) -> Iterator[int]:
    """Yield positions with the kind of a chunk, a length below 2**40 and a short name of the compression."""
    view = np.frombuffer(data, np.uint8)
    count = max(len(view) - 41, 0)
    zeros = [view[position : position + count] == 0 for position in (6, 7, 8, 38, 39, 40)]
    likely = np.logical_and.reduce(
        [view[:count] == mcap_records.Op.CHUNK, view[37 : 37 + count] <= len("zstd"), *zeros]
    )
    yield from np.flatnonzero(likely).tolist()


def _ros1_candidates(kind: _Ros1Kind) -> Callable[[bytes], Iterator[int]]:
    """Return a function that yields the positions of record headers that contain the field `op=` of the kind."""
    field = re.compile(re.escape(b"\x04\x00\x00\x00op=" + bytes([kind.op])))

    def candidates(data: bytes) -> Iterator[int]:
        next_start = 0
        for match in field.finditer(data):
            for start in range(max(match.start() - kind.max_before, next_start), match.start() - 3):
                (size,) = struct.unpack_from("<I", data, start)
                if match.end() - start - 4 <= size <= 2 * kind.max_before:
                    yield start
            next_start = max(match.start() - 3, next_start)

    return candidates
