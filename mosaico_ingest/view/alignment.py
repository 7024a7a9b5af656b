"""Topics of different rates in one table: the rows of each topic at common times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeAlias

import numpy as np
import pyarrow as pa
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.destinations.store.model import TopicInfo
from mosaico_ingest.errors import ViewError
from mosaico_ingest.findings import suggest_names
from mosaico_ingest.job.values import parse_duration, parse_rate

TIME = "timestamp_ns"
Int64s: TypeAlias = "NDArray[np.int64]"
Method: TypeAlias = Literal["backward", "nearest", "linear"]
_METHODS = ("backward", "nearest", "linear")
_arrow: Any = pa
"""pyarrow, whose stubs do not accept NumPy arrays and masks."""


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
