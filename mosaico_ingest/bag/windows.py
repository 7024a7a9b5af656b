"""This file reads a recording one stretch of time after the other, each small enough to be put in order in memory."""

from __future__ import annotations

from collections.abc import Collection, Iterator

from mosaico_ingest.bag.batch import RawBatch
from mosaico_ingest.bag.recording import Recording

__all__ = ["span", "windows"]

_USUAL_BYTES = 32 << 20
_MAX_BYTES = 256 << 20
_MAX_PIECES = 10_000


def span(recording: Recording) -> tuple[int, int]:
    """Return the log times of the first and the last message; without an index the recording is read for them."""
    if recording.start_ns is not None and recording.end_ns is not None:
        return recording.start_ns, recording.end_ns
    times = [(int(batch.log_times.min()), int(batch.log_times.max())) for batch in recording.batches()]
    return min((low for low, _ in times), default=0), max((high for _, high in times), default=0)


def windows(
    recording: Recording, channel_ids: Collection[int], *, max_bytes: int = _MAX_BYTES
) -> Iterator[list[RawBatch]]:
    """Yield all batches of each stretch of time, in order; one with more than `max_bytes` is halved.

    The first and the last stretch are open: an index may be wrong about the ends.
    """
    first, last = span(recording)
    step = max((last - first) // min(recording.size_bytes // _USUAL_BYTES + 1, _MAX_PIECES) + 1, 1)
    inner = range(first + step, last + 1, step)
    waiting = list(zip((None, *inner), (*inner, None), strict=True))[::-1]
    while waiting:
        low, high = waiting.pop()
        start, end = first if low is None else low, last + 1 if high is None else high
        batches = _read(recording, channel_ids, low, high, max_bytes if end - start > 1 else None)
        if batches is None:
            middle = start + (end - start) // 2
            waiting += [(middle, high), (low, middle)]
        else:
            yield batches


def _read(
    recording: Recording,
    channel_ids: Collection[int],
    low: int | None,
    high: int | None,
    max_bytes: int | None,
) -> list[RawBatch] | None:
    """Return the batches of a stretch, None where they are more than `max_bytes`."""
    found, size = list[RawBatch](), 0
    for batch in recording.batches(channel_ids, start_ns=low, end_ns=high):
        found.append(batch)
        size += int(batch.lengths.sum())
        if max_bytes is not None and size > max_bytes:
            return None
    return found
