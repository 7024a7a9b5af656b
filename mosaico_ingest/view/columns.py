"""Columns of a topic: their paths, values and types, and their statistics."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.types as pt
from msgspec import Struct

from mosaico_ingest.adapters.mapping.columns import time_ns
from mosaico_ingest.destinations.store.files import opened
from mosaico_ingest.destinations.store.model import TopicInfo
from mosaico_ingest.destinations.store.store import Window, scan
from mosaico_ingest.display import mean_rate_hz
from mosaico_ingest.ontology.registry import column_unit
from mosaico_ingest.report.parts import Timeline, TimelineReport

_compute: Any = pc
"""`pyarrow.compute`, whose stubs do not accept arrays of any type."""
_TIMES = ({"seconds", "nanoseconds"}, {"sec", "nanosec"}, {"secs", "nsecs"})
"""Names of the parts of a time or duration in ontology types and in the messages of ROS 2 and ROS 1."""
_TIMESTAMP = "timestamp_ns"
MAX_DISTINCT = 10_000
"""Number of distinct values of a column above which they are not counted."""
MAX_BINARY_BYTES = 64 << 20
"""Stored bytes of a binary column above which its values are not read."""


class Column(Struct, frozen=True):
    """A column without members: a value, a list, or a time in two parts."""

    path: str
    """The path, such as `acceleration.x`; `transforms[].translation.x` for members of the structs in a list."""
    steps: tuple[str, ...]
    """The names of the fields on the path."""
    type: pa.DataType
    """The type of the values; int64 for times."""
    is_time: bool = False
    """Whether the values are times or durations, in ns."""
    nullable: bool = True

    @property
    def name(self) -> str:
        """The top-level column."""
        return self.steps[0]

    def values(self, batch: pa.RecordBatch) -> pa.Array[Any]:
        """Return the values in a batch, one per row; null if a struct on the path is null.

        Members of the structs in a list have one value per struct instead.
        """
        values: pa.Array[Any] = batch.column(self.name)
        for step in self.steps[1:]:
            values = _member(values, step)
        return time_ns(values) if self.is_time and pt.is_struct(values.type) else values


def topic_columns(schema: pa.Schema) -> tuple[Column, ...]:
    """Return the columns of a topic in the order of the schema."""
    return tuple(column for field in schema for column in _walk(field, (), "", nullable=False))


def struct_paths(schema: pa.Schema) -> list[str]:
    """Return the paths of all columns and of the structs that contain them, such as `pose` and `pose.position.x`."""
    return [path for field in schema for path in _struct_paths(field, "")]


def path_values(table: pa.Table, path: str) -> pa.Array[Any]:
    """Return the values of a path such as `pose.position`, one per row."""
    name, *members = path.split(".")
    column = table.column(name)
    values: Any = _compute.struct_field(column, members) if members else column
    return values.combine_chunks() if isinstance(values, pa.ChunkedArray) else values


def flat_columns(path: str, values: pa.Array[Any]) -> Iterator[tuple[str, pa.Array[Any]]]:
    """Yield the path and the values of each column in a struct; times and lists remain as they are."""
    kind = values.type
    if not pt.is_struct(kind) or _is_time(kind):
        yield path, values
        return
    for member in kind:
        yield from flat_columns(f"{path}.{member.name}", _compute.struct_field(values, member.name))


def time_values(values: pa.Array[Any]) -> pa.Array[Any]:
    """Return times in two parts in ns, and other values unchanged."""
    return time_ns(values) if _is_time(values.type) else values


def is_number(kind: pa.DataType) -> bool:
    """Return whether values of this type are numbers."""
    return pt.is_integer(kind) or pt.is_floating(kind) or pt.is_decimal(kind)


def is_binary(kind: pa.DataType) -> bool:
    """Return whether values of this type are bytes."""
    return (
        pt.is_binary(kind)
        or pt.is_large_binary(kind)
        or pt.is_fixed_size_binary(kind)
        or pt.is_binary_view(kind)
    )


def is_list(kind: pa.DataType) -> bool:
    """Return whether values of this type are lists."""
    return pt.is_list(kind) or pt.is_large_list(kind) or pt.is_fixed_size_list(kind)


def _walk(field: pa.Field[Any], steps: tuple[str, ...], prefix: str, *, nullable: bool) -> Iterator[Column]:
    steps, path = (*steps, field.name), f"{prefix}{field.name}"
    kind: pa.DataType = field.type
    nullable = nullable or field.nullable
    if _is_time(kind):
        yield Column(path, steps, pa.int64(), is_time=True, nullable=nullable)
    elif pt.is_struct(kind):
        for member in kind:
            yield from _walk(member, steps, f"{path}.", nullable=nullable)
    elif is_list(kind) and pt.is_struct(_item_type(kind)) and not _is_time(_item_type(kind)):
        for member in cast("pa.StructType", _item_type(kind)):
            yield from _walk(member, steps, f"{path}[].", nullable=nullable)
    else:
        is_timestamp = path == _TIMESTAMP or pt.is_timestamp(kind)
        yield Column(path, steps, kind, is_time=is_timestamp, nullable=nullable)


def _struct_paths(field: pa.Field[Any], prefix: str) -> Iterator[str]:
    path = f"{prefix}{field.name}"
    yield path
    if pt.is_struct(field.type):
        for member in field.type:
            yield from _struct_paths(member, f"{path}.")


def _item_type(kind: pa.DataType) -> pa.DataType:
    return cast("pa.ListType[Any]", kind).value_type


def _is_time(kind: pa.DataType) -> bool:
    if not pt.is_struct(kind):
        return False
    members = list(kind)
    return {member.name for member in members} in _TIMES and all(pt.is_integer(m.type) for m in members)


def _member(values: pa.Array[Any], name: str) -> pa.Array[Any]:
    while is_list(values.type):
        values = cast("pa.ListArray[Any]", values).flatten()
    return _compute.struct_field(values, name)


class ColumnStatistics(Struct, frozen=True):
    """Statistics of the values of one column.

    For lists, `minimum`, `maximum`, `mean`, `nan` and `distinct` describe the items of all rows. For binary values, they
    describe the sizes in bytes.
    """

    path: str
    type: str
    unit: str
    """The unit, or an empty text if the column has none or none is known."""
    is_time: bool
    """Whether `minimum` and `maximum` are times or durations in ns."""
    rows: int | None
    """Number of rows that are not null; None if the values were not read."""
    nulls: int | None
    """Number of rows that are null."""
    nan: int
    minimum: Any
    """The smallest value that is not NaN, or None."""
    maximum: Any
    mean: float | None
    """The mean of the values that are finite; the share of true values of booleans; None for text and times."""
    distinct: int | None
    """Number of distinct values, or None if it exceeds `MAX_DISTINCT` or was not counted."""
    lengths: tuple[int, int] | None
    """The lengths of the shortest and the longest list."""


class TopicTiming(Struct, frozen=True):
    """The log times of a topic's rows."""

    rows: int
    start_ns: int | None
    end_ns: int | None
    rate_hz: float | None
    """Rows per second; see `mean_rate_hz`."""
    timeline: TimelineReport | None
    """Rows over time, the median interval, the jitter and the gaps; None without rows."""


class TopicStatistics(Struct, frozen=True):
    """Statistics of a topic."""

    sequence: str
    topic: str
    ontology: str
    timing: TopicTiming
    columns: tuple[ColumnStatistics, ...]


def describe_topic(topic: TopicInfo) -> TopicStatistics:
    """Read a topic once, batch by batch, and return its statistics.

    Large binary columns, such as images, are not read; their mean size comes from the metadata of the files.
    """
    columns = topic_columns(topic.schema)
    unread = _unread_columns(topic, columns)
    names = [name for name in topic.schema.names if name not in {column.name for column in unread}]
    tallies = {
        column.path: _Tally(column) for column in columns if column.path not in {c.path for c in unread}
    }
    clock = _Clock()
    selected = [column for column in columns if column.path in tallies]
    for batch in scan(topic.segments, _subset(topic.schema, names), Window()):
        clock.add(batch.column(0).to_numpy())
        for column in selected:
            tallies[column.path].add(column.values(batch))
    tag = topic.ontology.tag
    return TopicStatistics(
        topic.sequence,
        topic.name,
        tag,
        clock.timing(),
        tuple(
            tallies[column.path].statistics(tag)
            if column.path in tallies
            else _from_metadata(column, tag, unread[column], topic.rows)
            for column in columns
        ),
    )


def topic_timing(topic: TopicInfo) -> TopicTiming:
    """Read the times of a topic's rows, batch by batch, and return rate, jitter and gaps."""
    clock = _Clock()
    for batch in scan(topic.segments, _subset(topic.schema, topic.schema.names[:1]), Window()):
        clock.add(batch.column(0).to_numpy())
    return clock.timing()


@dataclass(slots=True)
class _Clock:
    """The times of rows, batch by batch."""

    timeline: Timeline = field(default_factory=Timeline)
    rows: int = 0
    first_ns: int | None = None
    last_ns: int | None = None

    def add(self, times_ns: npt.NDArray[np.int64]) -> None:
        """Add rows in order of time."""
        if not len(times_ns):
            return
        self.timeline.add(times_ns)
        self.rows += len(times_ns)
        self.first_ns = int(times_ns[0]) if self.first_ns is None else self.first_ns
        self.last_ns = int(times_ns[-1])

    def timing(self) -> TopicTiming:
        """Return the timing of all rows added so far."""
        rate_hz = mean_rate_hz(self.rows, self.first_ns, self.last_ns)
        return TopicTiming(self.rows, self.first_ns, self.last_ns, rate_hz, self.timeline.report())


class _Tally:
    """Statistics of one column, summed up batch by batch."""

    def __init__(self, column: Column) -> None:
        self._column = column
        self._rows = self._nulls = self._nan = self._finite = 0
        self._sum = 0.0
        self._low: Any = None
        self._high: Any = None
        self._lengths: tuple[int, int] | None = None
        self._distinct: pa.Array[Any] | None = None
        self._is_counted = True

    def add(self, values: pa.Array[Any]) -> None:
        """Add the values of a batch."""
        self._nulls += values.null_count
        self._rows += len(values) - values.null_count
        values = self._items(values.drop_null())
        if not len(values) or pt.is_null(values.type) or pt.is_struct(values.type):
            return
        if is_binary(values.type):
            values = _compute.binary_length(values)
        self._count_distinct(values)
        if pt.is_floating(values.type):
            values = self._without_nan(values.cast(pa.float64()))
        if len(values) and not pt.is_nested(values.type):
            self._add_bounds(values)

    def statistics(self, tag: str) -> ColumnStatistics:
        """Return the statistics of all values added so far."""
        column = self._column
        has_mean = self._finite > 0 and not column.is_time
        return ColumnStatistics(
            column.path,
            str(column.type),
            column_unit(tag, column.path.replace("[]", "")),
            column.is_time,
            self._rows,
            self._nulls,
            self._nan,
            self._low,
            self._high,
            self._sum / self._finite if has_mean else None,
            len(self._distinct) if self._is_counted and self._distinct is not None else None,
            self._lengths,
        )

    def _items(self, values: pa.Array[Any]) -> pa.Array[Any]:
        """Return the items of lists, with their lengths added to the statistics."""
        while is_list(values.type):
            if len(values):
                bounds = _compute.min_max(_compute.list_value_length(values)).as_py()
                low, high = self._lengths or (bounds["min"], bounds["max"])
                self._lengths = (min(low, bounds["min"]), max(high, bounds["max"]))
            values = cast("pa.ListArray[Any]", values).flatten().drop_null()
        return values

    def _without_nan(self, values: pa.Array[Any]) -> pa.Array[Any]:
        is_nan = _compute.is_nan(values)
        count = _compute.sum(is_nan).as_py() or 0
        self._nan += count
        return values.filter(_compute.invert(is_nan)) if count else values

    def _add_bounds(self, values: pa.Array[Any]) -> None:
        bounds = _compute.min_max(values).as_py()
        low, high = bounds["min"], bounds["max"]
        self._low = low if self._low is None else min(self._low, low)
        self._high = high if self._high is None else max(self._high, high)
        if is_number(values.type) or pt.is_boolean(values.type):
            numbers = values.cast(pa.float64(), safe=False)
            finite = numbers.filter(_compute.is_finite(numbers))
            self._finite += len(finite)
            self._sum += float(_compute.sum(finite).as_py() or 0)

    def _count_distinct(self, values: pa.Array[Any]) -> None:
        if not self._is_counted or pt.is_nested(values.type):
            return
        distinct = values.unique()
        if self._distinct is not None:
            distinct = pa.concat_arrays([self._distinct, distinct]).unique()
        self._distinct = distinct
        self._is_counted = len(distinct) <= MAX_DISTINCT


def _subset(schema: pa.Schema, names: Sequence[str]) -> pa.Schema:
    return pa.schema([schema.field(name) for name in names])


def _unread_columns(topic: TopicInfo, columns: Sequence[Column]) -> dict[Column, int]:
    """Return the binary columns that are too large to read, with their uncompressed size in bytes."""
    binary = [column for column in columns if is_binary(column.type)]
    if not binary or topic.stored_bytes <= MAX_BINARY_BYTES:
        return {}
    sizes = dict.fromkeys((column.name for column in binary), 0)
    for segment in topic.segments:
        with opened(segment.path) as file:
            for path, size in _chunk_sizes(file.metadata):
                if path.partition(".")[0] in sizes:
                    sizes[path.partition(".")[0]] += size
    return {column: sizes[column.name] for column in binary if sizes[column.name] > MAX_BINARY_BYTES}


def _chunk_sizes(footer: Any) -> Iterator[tuple[str, int]]:  # noqa: ANN401 - the stubs of pyarrow have no columns
    for group in range(footer.num_row_groups):
        row_group = footer.row_group(group)
        for number in range(row_group.num_columns):
            chunk = row_group.column(number)
            yield chunk.path_in_schema, chunk.total_uncompressed_size


def _from_metadata(column: Column, tag: str, size: int, rows: int) -> ColumnStatistics:
    """Return the statistics of a binary column whose values were not read."""
    return ColumnStatistics(
        column.path,
        str(column.type),
        column_unit(tag, column.path),
        is_time=False,
        rows=None,
        nulls=None if column.nullable else 0,
        nan=0,
        minimum=None,
        maximum=None,
        mean=size / rows if rows else None,
        distinct=None,
        lengths=None,
    )
