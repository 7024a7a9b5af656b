"""This file moves many messages at once: checks, sorts, splits and packs them without a step per message."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from mosaico_ingest.bag.containers.part import LATEST_NS, Hole, Loaded, Slab, Want

__all__ = ["Bytes", "by_key", "in_time", "keep", "keep_each", "pack", "stretches"]

_FEW_ROWS = 8
"""With fewer rows to a length on average, one index for every byte is cheaper than one step for every length."""
_SMALLEST_WORD, _LARGEST_WORD = 4, 64
"""Messages of many lengths are gathered in words, so that an index is needed for each word and not for each byte."""

Bytes = NDArray[np.uint8]
Longs = NDArray[np.int64]


def stretches(data: Bytes, starts: Longs, size: int) -> Bytes:
    """Return the `size` bytes from each start on, shape (len(starts), size); the caller checked the bounds."""
    windows = np.ndarray((len(data) - size + 1, size), np.uint8, data, strides=(1, 1))
    return windows[starts]


def by_key(keys: NDArray[np.integer]) -> Iterator[tuple[int, Longs]]:
    """Yield each key with the rows that have it, in their order."""
    order = np.argsort(keys, kind="stable")
    ranked = keys[order]
    edges = np.flatnonzero(np.diff(ranked)) + 1
    for rows in np.split(order, edges) if len(order) else []:
        yield int(keys[rows[0]]), rows


def keep(slab: Slab, want: Want, loaded: Loaded) -> None:
    """Add the messages within the wanted time."""
    slab = _wanted(slab, want, loaded.holes)
    if len(slab):
        loaded.slabs.append(slab)


def keep_each(whole: Slab, streams: Iterable[tuple[int, Longs | slice]], want: Want, loaded: Loaded) -> None:
    """Add the messages within the wanted time, stream by stream: its key, and its rows of the whole."""
    if _is_inside(whole, want):
        slabs = [whole.rows(rows, key=key) for key, rows in streams]
        loaded.slabs.extend(slab for slab in slabs if len(slab))
        return
    for key, rows in streams:
        keep(whole.rows(rows, key=key), want, loaded)


def _is_inside(slab: Slab, want: Want) -> bool:
    if not len(slab):
        return True
    first, last = int(slab.log_times.min()), int(slab.log_times.max())
    return max(want.start_ns, 0) <= first and last < want.end_ns


def _wanted(slab: Slab, want: Want, holes: list[Hole]) -> Slab:
    """Return the messages within the wanted time; those after 2262 are noted as lost."""
    if _is_inside(slab, want):
        return slab
    times = slab.log_times
    broken = times < 0  # unsigned in the file
    if bool(broken.any()):
        offset = int(slab.offsets[int(broken.argmax())])
        reason = f"recorded at {int(times.view(np.uint64).max())} ns, which is after the year 2262"
        holes.append(Hole(offset, reason, key=slab.key, count=int(broken.sum())))
    keep_rows = ~broken & (times >= want.start_ns)
    if want.end_ns <= LATEST_NS:
        keep_rows &= times < want.end_ns
    return slab.rows(keep_rows)


def in_time(slab: Slab) -> Slab:
    """Return the messages by log time; those of the same time stay in their order."""
    times = slab.log_times
    if len(times) < 2 or bool((times[1:] >= times[:-1]).all()):  # noqa: PLR2004 - one message is in order
        return slab
    return slab.rows(np.argsort(times, kind="stable"))


def pack(slab: Slab) -> Slab:
    """Return the same messages in a buffer of their own, equal lengths side by side, or each filled up to whole words."""
    lengths = slab.lengths
    shortest, longest = int(lengths.min()), int(lengths.max())
    if shortest == longest:
        data = stretches(slab.data, slab.starts, shortest).reshape(-1)
        return _with(slab, data, np.arange(len(slab), dtype=np.int64) * shortest)
    kinds = np.unique(lengths)
    if len(kinds) * _FEW_ROWS > len(lengths):
        return _with(slab, *_gather(slab))
    starts = np.empty(len(slab), np.int64)
    pieces: list[Bytes] = []
    end = 0
    for length in kinds.tolist():
        rows = np.flatnonzero(lengths == length)
        starts[rows] = end + np.arange(len(rows), dtype=np.int64) * length
        pieces.append(stretches(slab.data, slab.starts[rows], length).reshape(-1))
        end += len(rows) * length
    return _with(slab, np.concatenate(pieces), starts)


def _with(slab: Slab, data: Bytes, starts: Longs) -> Slab:
    times, lengths, offsets = map(_own, (slab.log_times, slab.lengths, slab.offsets))
    return Slab(slab.key, times, data, starts, lengths, offsets)


def _own(values: Longs) -> Longs:
    """Return a copy of a view: messages of a rare topic wait long, and a view keeps the whole buffer alive."""
    return values if values.base is None else values.copy()


def _gather(slab: Slab) -> tuple[Bytes, Longs]:
    """Return the payloads one after the other, in whole words, and where each begins."""
    data, size = slab.data, _word_bytes(slab)
    words = -(-slab.lengths // size)
    ends = np.cumsum(words)
    starts = (ends - words) * size
    index = np.repeat(slab.starts - starts, words)
    index += np.arange(0, len(index) * size, size)
    room = len(data) - size
    index[index > room] = 0  # the last words of the last messages, see below
    out = np.ndarray(room + 1, f"V{size}", data, strides=1)[index].view(np.uint8)
    for row in np.flatnonzero(slab.starts + words * size > len(data)).tolist():
        start, length = int(slab.starts[row]), int(slab.lengths[row])
        out[starts[row] : starts[row] + length] = data[start : start + length]
    return out, starts


def _word_bytes(slab: Slab) -> int:
    """Return a power of two of which an average message has four to eight, or 1 where the buffer has not even one."""
    if len(slab.data) < _LARGEST_WORD:
        return 1
    average = slab.payload_bytes // len(slab)
    return min(max(1 << max(average.bit_length() - 3, 0), _SMALLEST_WORD), _LARGEST_WORD)
