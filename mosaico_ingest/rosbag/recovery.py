"""This file finds the next chunk or message behind bytes that are no records, in files whose own index is lost."""

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

__all__ = ["next_mcap_chunk", "next_ros1_chunk", "next_ros1_message"]

_STEP_BYTES = 1 << 20
_OVERLAP_BYTES = 1 << 10
"""More than what is recognised at once."""
_HEAD_BYTES = 256
"""More than the fixed part of any chunk record."""


class _Ros1Kind(Struct, frozen=True):
    """How the records of a kind are recognised."""

    op: int
    fields: frozenset[bytes]
    before: int
    """How far before its `op=` a header may begin."""


_ROS1_CHUNK = _Ros1Kind(ros1_records.Op.CHUNK, frozenset({b"compression", b"size"}), 128)
_ROS1_MESSAGE = _Ros1Kind(
    ros1_records.Op.MESSAGE, frozenset({b"topic", b"type", b"md5", b"sec", b"nsec"}), 512
)


def next_mcap_chunk(source: Source, at: int, stop: int) -> int | None:
    """Return where the next whole MCAP chunk begins, between `at` and `stop`."""

    def is_chunk(place: int) -> bool:
        data = source.read_some(place, _HEAD_BYTES)
        try:
            head = mcap_records.chunk_head(data)
        except BagError:
            return False
        _, length = mcap_records.RECORD.unpack_from(data)
        end = mcap_records.RECORD.size + length
        return head.end == end and place + end <= stop and head.compression in {"", "zstd", "lz4"}

    return _search(source, at, stop, _mcap_candidates, is_chunk)


def next_ros1_chunk(source: Source, at: int, stop: int) -> int | None:
    """Return where the next whole chunk of a ROS 1 bag begins, between `at` and `stop`."""
    return _search(source, at, stop, _candidates(_ROS1_CHUNK), _has(source, stop, _ROS1_CHUNK))


def next_ros1_message(source: Source, at: int, stop: int) -> int | None:
    """Return where the next whole message of a bag of version 1.2 begins, between `at` and `stop`."""
    return _search(source, at, stop, _candidates(_ROS1_MESSAGE), _has(source, stop, _ROS1_MESSAGE))


def _has(source: Source, stop: int, kind: _Ros1Kind) -> Callable[[int], bool]:
    """Return what says whether a whole record of a kind begins somewhere."""
    window = Window(source)

    def fits(place: int) -> bool:
        try:
            record = ros1_records.record_at(window, place, stop)
        except BagError:
            return False
        return record.op == kind.op and kind.fields <= record.header.keys()

    return fits


def _search(
    source: Source,
    at: int,
    stop: int,
    candidates: Callable[[bytes], Iterator[int]],
    fits: Callable[[int], bool],
) -> int | None:
    while at < stop:
        data = source.read_some(at, min(_STEP_BYTES, stop - at))
        for place in candidates(data):
            if fits(at + place):
                return at + place
        if len(data) < _STEP_BYTES:
            return None
        at += _STEP_BYTES - _OVERLAP_BYTES
    return None


def _mcap_candidates(data: bytes) -> Iterator[int]:
    """Yield where the kind, a length below 2**40 and a short compression name stand as in a chunk record."""
    view = np.frombuffer(data, np.uint8)
    count = max(len(view) - 41, 0)
    zeros = [view[place : place + count] == 0 for place in (6, 7, 8, 38, 39, 40)]
    likely = np.logical_and.reduce(
        [view[:count] == mcap_records.Op.CHUNK, view[37 : 37 + count] <= len("zstd"), *zeros]
    )
    yield from np.flatnonzero(likely).tolist()


def _candidates(kind: _Ros1Kind) -> Callable[[bytes], Iterator[int]]:
    """Return what yields where a record header begins that reaches over the field `op=` of a kind."""
    field = re.compile(re.escape(b"\x04\x00\x00\x00op=" + bytes([kind.op])))

    def candidates(data: bytes) -> Iterator[int]:
        tried = 0
        for found in field.finditer(data):
            for begin in range(max(found.start() - kind.before, tried), found.start() - 3):
                (size,) = struct.unpack_from("<I", data, begin)
                if found.end() - begin - 4 <= size <= 2 * kind.before:
                    yield begin
            tried = max(found.start() - 3, tried)

    return candidates
