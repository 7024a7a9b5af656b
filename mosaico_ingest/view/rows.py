"""Rows of topics: selected rows of one topic, and rows of several topics at common times.

Row groups that contain no selected row are not read, so the time does not depend on the size of the topic.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.destinations.store.files import opened, translate_errors
from mosaico_ingest.destinations.store.model import SegmentInfo, TopicInfo
from mosaico_ingest.destinations.store.segment import time_span
from mosaico_ingest.destinations.store.store import Window, scan
from mosaico_ingest.errors import ViewError
from mosaico_ingest.findings import suggest_names
from mosaico_ingest.job.values import parse_duration, parse_rate

TIME = "timestamp_ns"
Int64s: TypeAlias = "NDArray[np.int64]"
Method: TypeAlias = Literal["backward", "nearest", "linear"]
_METHODS = ("backward", "nearest", "linear")
_arrow: Any = pa
"""pyarrow, whose stubs do not accept NumPy arrays and masks."""


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
    schema = column_schema(topic, columns)
    batches: list[pa.RecordBatch] = []
    missing = count
    if count:
        for batch in scan(topic.segments, schema, Window(start_ns)):
            batches.append(batch.slice(0, missing))
            missing -= batches[-1].num_rows
            if not missing:
                break
    return pa.Table.from_batches(batches, schema)


def last_rows(
    topic: TopicInfo, count: int, *, columns: Sequence[str] | None = None, end_ns: int | None = None
) -> pa.Table:
    """Return the last `count` rows at or before `end_ns`, ordered by time."""
    schema = column_schema(topic, columns)
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
    schema = column_schema(topic, columns)
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
    schema = column_schema(topic, columns)
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


def column_schema(topic: TopicInfo, columns: Iterable[str] | None) -> pa.Schema:
    """Return the schema of the timestamps and of some other columns, or of all columns for None."""
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


def align(
    topics: Mapping[str, TopicInfo | pa.Table],
    at: str | Sequence[int] | Int64s,
    *,
    method: Method = "backward",
    tolerance: str | int | None = None,
) -> pa.Table:
    """Return one row per time with the values of all topics at that time.

    The table has the column `timestamp_ns` and, for each topic, the columns `<name>.<column>` with structs flattened,
    such as `imu.acceleration.x`. `<name>.timestamp_ns` is the time of the row with these values. All columns of a
    topic are null at times without a row.

    Args:
        topics: Topics of a store by the name of their columns, or tables with the column `timestamp_ns`, such as
            `topic.to_arrow(columns=["pose"])`. All selected rows are loaded into memory.
        at: The times: the name of a topic, a rate such as `10 Hz` (regular times while all topics have rows), or ns since
            the epoch.
        method: `backward` uses the last row at or before a time. `nearest` uses the closest row, or the earlier one of two.
            `linear` interpolates columns of numbers between the rows before and after a time, with integers as float64;
            other columns are as with `backward`, and the numbers are null outside the time range of the topic.
        tolerance: The longest distance between a time and the rows used: a duration such as `50 ms`, or ns.

    Raises:
        ViewError: An argument is invalid.
        SinkError: A topic cannot be read.
    """
    if method not in _METHODS:
        raise ViewError(f"the method is {method!r}", hint=f"use {', '.join(_METHODS)}")
    tables = {name: _sorted_table(name, topic) for name, topic in topics.items()}
    if not tables:
        raise ViewError("there is no topic to align", hint="pass at least one topic")
    own_times = {name: _times_of(table) for name, table in tables.items()}
    times = _common_times(at, own_times)
    limit = _nanoseconds(tolerance)
    columns: dict[str, Any] = {TIME: _arrow.array(times)}
    for name, table in tables.items():
        rows = _RowsAt.find(own_times[name], times, limit, nearest=method == "nearest")
        pair = _Pair.find(own_times[name], times, limit) if method == "linear" else None
        for field in table.schema:
            column = table.column(field.name)
            key = f"{name}.{field.name}"
            if pair is not None and field.name != TIME and _is_number(field.type):
                columns[key] = pair.interpolate(column)
            else:
                columns[key] = column.take(_arrow.array(rows.positions, mask=~rows.is_valid))
    return pa.table(columns)


def _sorted_table(name: str, topic: TopicInfo | pa.Table) -> pa.Table:
    table = topic.to_arrow(flatten=True) if isinstance(topic, TopicInfo) else topic
    if TIME not in table.schema.names or table.schema.field(TIME).type != pa.int64():
        raise ViewError(f"the table {name!r} has no column {TIME} of int64", hint="pass a topic of a store")
    while any(pa.types.is_struct(field.type) for field in table.schema):
        table = table.flatten()
    times = _times_of(table)
    return table if bool((times[1:] >= times[:-1]).all()) else table.take(np.argsort(times, kind="stable"))


def _times_of(table: pa.Table) -> Int64s:
    column: Any = table.column(TIME)  # the stubs do not declare the type of the NumPy array
    return column.to_numpy()


def _common_times(at: str | Sequence[int] | Int64s, own_times: Mapping[str, Int64s]) -> Int64s:
    if not isinstance(at, str):
        return np.asarray(at, np.int64)
    if at in own_times:
        return own_times[at]
    try:
        hertz = parse_rate(at)
    except ValueError:
        hertz = 0.0
    if not hertz:
        raise ViewError(
            f"{at!r} is neither a topic nor a rate",
            hint=suggest_names(own_times, [at]) or "write a rate such as 10 Hz",
        )
    if not all(len(times) for times in own_times.values()):
        return np.empty(0, np.int64)
    start = max(int(times[0]) for times in own_times.values())
    end = min(int(times[-1]) for times in own_times.values())
    count = max(0, int((end - start) * hertz / 1e9) + 1) if end >= start else 0
    return start + np.round(np.arange(count) * (1e9 / hertz)).astype(np.int64)


def _nanoseconds(tolerance: str | int | None) -> np.uint64:
    """Return a duration in ns; the largest integer for None."""
    if tolerance is None:
        return np.uint64(2**64 - 1)
    try:
        length = parse_duration(tolerance) if isinstance(tolerance, str) else tolerance
    except ValueError as error:
        raise ViewError(f"tolerance: {error}") from error
    if length < 0:
        raise ViewError(f"the tolerance is {tolerance}", hint="write a duration such as 50 ms")
    return np.uint64(length)


def _is_number(kind: pa.DataType) -> bool:
    return pa.types.is_integer(kind) or pa.types.is_floating(kind)


def _distance(later: Int64s, earlier: Int64s) -> NDArray[np.uint64]:
    """Return differences that can exceed int64."""
    return later.astype(np.uint64) - earlier.astype(np.uint64)


class _RowsAt(Struct, frozen=True):
    """The row of a topic for each time."""

    positions: Int64s
    is_valid: NDArray[np.bool_]
    """False at times without a row; the position is then 0."""

    @classmethod
    def find(cls, own: Int64s, times: Int64s, limit: np.uint64, *, nearest: bool) -> _RowsAt:
        """Find the last row at or before each time, or the nearest one."""
        if not len(own):
            return cls(np.zeros(len(times), np.int64), np.zeros(len(times), bool))
        before = np.searchsorted(own, times, side="right").astype(np.int64) - 1
        is_valid, positions = before >= 0, np.maximum(before, 0)
        distance = _distance(times, own[positions])
        if nearest:
            after = np.minimum(np.searchsorted(own, times, side="left"), len(own) - 1)
            is_later = own[after] > times
            closer = is_later & (~is_valid | (_distance(own[after], times) < distance))
            positions = np.where(closer, after, positions)
            distance = np.where(closer, _distance(own[after], times), distance)
            is_valid |= closer
        is_valid &= distance <= limit
        return cls(np.where(is_valid, positions, 0), is_valid)


class _Pair(Struct, frozen=True):
    """The rows of a topic before and after each time, and the weight of the later one."""

    before: Int64s
    after: Int64s
    weights: NDArray[np.float64]
    """0 at the time of a row."""
    is_valid: NDArray[np.bool_]

    @classmethod
    def find(cls, own: Int64s, times: Int64s, limit: np.uint64) -> _Pair:
        """Find both rows; they are the same row at its own time."""
        rows = _RowsAt.find(own, times, limit, nearest=False)
        if not len(own):
            return cls(rows.positions, rows.positions, np.zeros(len(times)), rows.is_valid)
        is_exact = own[rows.positions] == times
        after = np.where(is_exact, rows.positions, rows.positions + 1)
        is_valid = rows.is_valid & (after < len(own))
        after = np.where(is_valid, after, 0)
        is_valid &= is_exact | (_distance(own[after], times) <= limit)
        span = _distance(own[after], own[rows.positions]).astype(np.float64)
        elapsed = _distance(times, own[rows.positions]).astype(np.float64)
        weights = np.divide(elapsed, span, out=np.zeros(len(times)), where=is_valid & ~is_exact)
        return cls(np.where(is_valid, rows.positions, 0), after, weights, is_valid)

    def interpolate(self, column: Any) -> Any:  # noqa: ANN401 - a chunked array of numbers
        """Return the numbers at all times; null if one of the two rows has none."""
        kind = column.type if pa.types.is_floating(column.type) else pa.float64()
        if not len(column):
            return _arrow.nulls(len(self.before), kind)
        absent = np.asarray(column.is_null())
        numbers = column.to_numpy().astype(np.float64)
        earlier, later = numbers[self.before], numbers[self.after]
        with np.errstate(invalid="ignore", over="ignore"):  # infinite values have no line between them
            values = np.where(self.weights == 0, earlier, earlier * (1 - self.weights) + later * self.weights)
        mask = ~self.is_valid | absent[self.before] | absent[self.after]
        return _arrow.array(values.astype(kind.to_pandas_dtype()), kind, mask=mask)
