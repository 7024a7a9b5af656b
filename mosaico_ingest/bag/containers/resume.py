"""This file finds the next chunk behind bytes that are no records, in files whose own index is lost."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator

import numpy as np

from mosaico_ingest.bag.containers import mcap_records, ros1_records
from mosaico_ingest.bag.containers.source import Source, Window
from mosaico_ingest.errors import BagError

__all__ = ["next_mcap_chunk", "next_ros1_chunk"]

_STEP_BYTES = 1 << 20
_HEAD_BYTES = 256
"""More than the fixed part of any chunk record."""
_ROS1_CHUNK = re.compile(rb"\x04\x00\x00\x00op=\x05")


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

    def is_chunk(place: int) -> bool:
        try:
            record = ros1_records.record_at(Window(source), place, stop)
        except BagError:
            return False
        return record.op == ros1_records.Op.CHUNK and {b"compression", b"size"} <= record.header.keys()

    return _search(source, at, stop, _ros1_candidates, is_chunk)


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
        at += _STEP_BYTES - _HEAD_BYTES
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


def _ros1_candidates(data: bytes) -> Iterator[int]:
    """Yield where a record header begins that reaches over the field `op=` of a chunk."""
    for found in _ROS1_CHUNK.finditer(data):
        for begin in range(max(found.start() - _HEAD_BYTES // 2, 0), found.start() - 3):
            (size,) = struct.unpack_from("<I", data, begin)
            if found.end() - begin - 4 <= size <= _HEAD_BYTES:
                yield begin
