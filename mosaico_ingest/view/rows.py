"""Selected rows of a topic: the first, the last, evenly spaced ones, and the nearest to a time.

Row groups that contain no selected row are not read, so the time does not depend on the size of the topic.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.destinations.store.files import opened, translate_errors
from mosaico_ingest.destinations.store.model import SegmentInfo, TopicInfo
from mosaico_ingest.destinations.store.segment import time_span
from mosaico_ingest.destinations.store.store import Window, scan


class _RowGroup(Struct, frozen=True):
    segment: SegmentInfo
    number: int
    rows: int
    start_ns: int
    end_ns: int
    """The largest time, inclusive."""

    def distance(self, at_ns: int) -> int:
        """Return the time between `at_ns` and the nearest row that the group may contain, in ns."""
        return max(self.start_ns - at_ns, at_ns - self.end_ns, 0)


def first_rows(
    topic: TopicInfo, count: int, *, columns: Sequence[str] | None = None, start_ns: int | None = None
) -> pa.Table:
    """Return the first `count` rows at or after `start_ns`, ordered by time.

    `columns` are names of top-level columns; `timestamp_ns` is always the first column.
    """
    schema = _schema(topic, columns)
    batches: list[pa.RecordBatch] = []
    rest = count
    if count:
        for batch in scan(topic.segments, schema, Window(start_ns)):
            batches.append(batch.slice(0, rest))
            rest -= batches[-1].num_rows
            if not rest:
                break
    return pa.Table.from_batches(batches, schema)


def last_rows(
    topic: TopicInfo, count: int, *, columns: Sequence[str] | None = None, end_ns: int | None = None
) -> pa.Table:
    """Return the last `count` rows at or before `end_ns`, ordered by time."""
    schema = _schema(topic, columns)
    window = Window(_start_of_last(topic, count, end_ns), None if end_ns is None else end_ns + 1)
    batches: list[pa.RecordBatch] = []
    rows = 0
    for batch in scan(topic.segments, schema, window) if count else ():
        batches.append(batch)
        rows += batch.num_rows
        while rows - batches[0].num_rows >= count:
            rows -= batches.pop(0).num_rows
    return pa.Table.from_batches(batches, schema).slice(max(0, rows - count))


def sampled_rows(topic: TopicInfo, count: int, *, columns: Sequence[str] | None = None) -> pa.Table:
    """Return `count` rows at equal distances, including the first and the last one, ordered by time."""
    schema = _schema(topic, columns)
    positions = np.unique(np.linspace(0, topic.rows - 1, min(count, topic.rows)).round().astype(np.int64))
    tables = [schema.empty_table()]
    start = 0
    for segment in topic.segments:
        inside = positions[(positions >= start) & (positions < start + segment.rows)] - start
        if len(inside):
            tables.append(_rows_of(segment, schema, inside))
        start += segment.rows
    return pa.concat_tables(tables).sort_by(schema.names[0])


def rows_near(topic: TopicInfo, times_ns: Sequence[int], *, columns: Sequence[str] | None = None) -> pa.Table:
    """Return the row nearest to each time, without repetitions, ordered by time."""
    schema = _schema(topic, columns)
    groups = list(_row_groups(topic.segments))
    nearest = {_nearest(groups, at_ns, schema.names[0]) for at_ns in times_ns} - {None}
    tables = [schema.empty_table()]
    for group in dict.fromkeys(position[0] for position in nearest if position is not None):
        rows = sorted(position[1] for position in nearest if position is not None and position[0] is group)
        tables.append(_read(group, schema).take(pa.array(rows)))
    return pa.concat_tables(tables).sort_by(schema.names[0])


def nearest_row(
    topic: TopicInfo, at_ns: int | None = None, *, columns: Sequence[str] | None = None
) -> dict[str, Any] | None:
    """Return the row nearest to `at_ns` (default: the first row) as Python values, or None without rows."""
    table = (
        first_rows(topic, 1, columns=columns) if at_ns is None else rows_near(topic, [at_ns], columns=columns)
    )
    rows = table.to_pylist()
    return rows[0] if rows else None


def _schema(topic: TopicInfo, columns: Sequence[str] | None) -> pa.Schema:
    if columns is None:
        return topic.schema
    names = dict.fromkeys([topic.schema.names[0], *columns])
    return pa.schema([topic.schema.field(name) for name in names])


def _start_of_last(topic: TopicInfo, count: int, end_ns: int | None) -> int | None:
    """Return a time from which on there are at least `count` rows until `end_ns`, or None for all rows."""
    groups: list[_RowGroup] = []
    for segment in sorted(topic.segments, key=lambda segment: segment.end_ns, reverse=True):
        groups += [group for group in _row_groups([segment]) if end_ns is None or group.end_ns <= end_ns]
        groups.sort(key=lambda group: group.start_ns, reverse=True)
        rows = 0
        for group in groups:
            rows += group.rows
            if rows >= count:
                return group.start_ns
    return None


def _row_groups(segments: Sequence[SegmentInfo]) -> Iterator[_RowGroup]:
    for segment in segments:
        with translate_errors(str(segment.path)), opened(segment.path) as file:
            for number in range(file.num_row_groups):
                start_ns, end_ns = time_span(file.metadata, number)
                rows = file.metadata.row_group(number).num_rows
                yield _RowGroup(segment, number, rows, start_ns, end_ns)


def _nearest(groups: Sequence[_RowGroup], at_ns: int, name: str) -> tuple[_RowGroup, int] | None:
    """Return the row group and the position in it of the row nearest to a time; the earlier one of two."""
    best: tuple[int, int, _RowGroup, int] | None = None
    for group in sorted(groups, key=lambda group: (group.distance(at_ns), group.start_ns)):
        if best is not None and group.distance(at_ns) > best[0]:
            break
        times = _times(group, name)
        row = int(np.searchsorted(times, at_ns))
        for at in range(max(0, row - 1), min(len(times), row + 1)):
            candidate = (abs(int(times[at]) - at_ns), int(times[at]), group, at)
            if best is None or candidate[:2] < best[:2]:
                best = candidate
    return None if best is None else (best[2], best[3])


def _times(group: _RowGroup, name: str) -> npt.NDArray[np.int64]:
    with translate_errors(str(group.segment.path)), opened(group.segment.path) as file:
        return file.read_row_group(group.number, columns=[name]).column(0).to_numpy()


def _read(group: _RowGroup, schema: pa.Schema) -> pa.Table:
    with translate_errors(str(group.segment.path)), opened(group.segment.path) as file:
        return _as(schema, file.read_row_group(group.number, columns=schema.names))


def _rows_of(segment: SegmentInfo, schema: pa.Schema, positions: npt.NDArray[np.int64]) -> pa.Table:
    """Return the rows at these positions of a segment."""
    tables: list[pa.Table] = []
    start = 0
    with translate_errors(str(segment.path)), opened(segment.path) as file:
        for number in range(file.num_row_groups):
            rows = file.metadata.row_group(number).num_rows
            inside = positions[(positions >= start) & (positions < start + rows)] - start
            if len(inside):
                table = _as(schema, file.read_row_group(number, columns=schema.names))
                tables.append(table.take(inside))
            start += rows
    return pa.concat_tables(tables)


def _as(schema: pa.Schema, table: pa.Table) -> pa.Table:
    """Return the columns in the order of the schema."""
    return pa.Table.from_arrays([table.column(name) for name in schema.names], schema=schema)
