"""This file reads a topic in time order: segments are sorted, so only those that overlap are merged."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import pyarrow as pa

from mosaico_ingest.frozen import frozen
from mosaico_ingest.store.faults import explained
from mosaico_ingest.store.files import opened
from mosaico_ingest.store.model import SegmentInfo
from mosaico_ingest.store.segment import sorted_rows, time_span

__all__ = ["Window", "count", "scan"]

_BATCH_ROWS = 1 << 16


@frozen
class Window:
    """A span of time, its start in, its end out; None is open."""

    start_ns: int | None = None
    end_ns: int | None = None

    def overlaps(self, start_ns: int, end_ns: int) -> bool:
        """Return whether rows from `start_ns` to `end_ns`, both in, may be inside."""
        early = self.start_ns is not None and end_ns < self.start_ns
        late = self.end_ns is not None and start_ns >= self.end_ns
        return not early and not late

    def covers(self, start_ns: int, end_ns: int) -> bool:
        """Return whether rows from `start_ns` to `end_ns`, both in, are all inside."""
        early = self.start_ns is not None and start_ns < self.start_ns
        late = self.end_ns is not None and end_ns >= self.end_ns
        return not early and not late

    def cut(self, batch: pa.RecordBatch) -> pa.RecordBatch:
        """Return the rows inside; the batch is sorted and is not copied."""
        times = batch.column(0).to_numpy()
        start = 0 if self.start_ns is None else int(np.searchsorted(times, self.start_ns))
        end = len(times) if self.end_ns is None else int(np.searchsorted(times, self.end_ns))
        return batch.slice(start, max(0, end - start))


def scan(segments: Sequence[SegmentInfo], schema: pa.Schema, window: Window) -> Iterator[pa.RecordBatch]:
    """Yield the rows of the columns in `schema`, whose first is `timestamp_ns`, sorted by it."""
    wanted = [segment for segment in segments if window.overlaps(segment.start_ns, segment.end_ns)]
    for together in _overlapping(wanted):
        streams = [_read(segment, schema, window) for segment in together]
        yield from streams[0] if len(streams) == 1 else _merge(streams, schema)


def count(
    segments: Sequence[SegmentInfo], schema: pa.Schema, window: Window
) -> tuple[int, int | None, int | None]:
    """Return how many rows are inside, and the first and the last of their time stamps."""
    times = pa.schema([schema.field(0)])
    rows, stamps = 0, list[int]()
    for segment in segments:
        if window.covers(segment.start_ns, segment.end_ns):
            rows += segment.rows
            stamps += [segment.start_ns, segment.end_ns]
            continue
        for batch in scan([segment], times, window):
            rows += batch.num_rows
            stamps += [batch.column(0)[0].as_py(), batch.column(0)[-1].as_py()]
    return rows, min(stamps, default=None), max(stamps, default=None)


def _overlapping(segments: Iterable[SegmentInfo]) -> Iterator[list[SegmentInfo]]:
    """Yield groups of segments, in time order, that have no time in common with another group."""
    group: list[SegmentInfo] = []
    end_ns = 0
    for segment in sorted(segments, key=lambda each: each.start_ns):
        if group and segment.start_ns >= end_ns:
            yield group
            group = []
        end_ns = max(end_ns, segment.end_ns) if group else segment.end_ns
        group.append(segment)
    if group:
        yield group


def _read(segment: SegmentInfo, schema: pa.Schema, window: Window) -> Iterator[pa.RecordBatch]:
    with explained(str(segment.path)), opened(segment.path) as file:
        for group in range(file.num_row_groups):
            if not window.overlaps(*time_span(file.metadata, group)):
                continue
            for batch in file.iter_batches(_BATCH_ROWS, row_groups=[group], columns=schema.names):
                inside = window.cut(batch)
                if inside.num_rows:
                    yield pa.RecordBatch.from_arrays(inside.columns, schema=schema)


def _merge(streams: Sequence[Iterator[pa.RecordBatch]], schema: pa.Schema) -> Iterator[pa.RecordBatch]:
    """Yield the rows of sorted streams in order; one batch of each is in memory at a time."""
    heads = [next(stream, None) for stream in streams]
    while live := [head for head in heads if head is not None]:
        horizon = min(head.column(0)[-1].as_py() for head in live)
        ready: list[pa.RecordBatch] = []
        for i, head in enumerate(heads):
            if head is None:
                continue
            split = int(np.searchsorted(head.column(0).to_numpy(), horizon, side="right"))
            ready.append(head.slice(0, split))
            heads[i] = head.slice(split) if split < head.num_rows else next(streams[i], None)
        yield from sorted_rows(ready, schema).combine_chunks().to_batches(_BATCH_ROWS)
