"""Scalar fields of a topic over time, reduced to a few points that keep every extreme value."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.types as pt
from msgspec import Struct

from mosaico_ingest.destinations.store.model import TopicInfo
from mosaico_ingest.destinations.store.store import Window, scan
from mosaico_ingest.errors import ViewError
from mosaico_ingest.findings import suggest_names
from mosaico_ingest.ontology.registry import column_unit
from mosaico_ingest.view.columns import Column, is_list, is_number, topic_columns
from mosaico_ingest.view.rows import first_rows

MAX_ITEMS = 8
"""Items of a list that are plotted if the field does not select one."""
MAX_DEFAULT = 6
"""Fields that are plotted if none are named."""
_ITEM = re.compile(r"(.+)\[(\d+)\]")
_METADATA = frozenset(
    {"header", "covariance", "covariance_type", "variance", "variance_type", "timestamp_ns"}
)
"""Parts of a path whose values are not measurements."""


class Series(Struct, frozen=True):
    """A scalar field over time."""

    label: str
    """The column, such as `acceleration.z` or `positions[2]`."""
    unit: str
    times_ns: npt.NDArray[np.int64]
    values: npt.NDArray[np.float64]
    """NaN for null, and where a list is too short."""


class _Field(Struct, frozen=True):
    column: Column
    item: int | None = None

    @property
    def label(self) -> str:
        return self.column.path if self.item is None else f"{self.column.path}[{self.item}]"

    def values(self, batch: pa.RecordBatch) -> npt.NDArray[np.float64]:
        values = self.column.values(batch)
        if self.item is not None:
            values = _items(values, self.item)
        if pt.is_boolean(values.type):
            values = values.cast(pa.uint8())
        numbers = values.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
        return numbers / 1e9 if self.column.is_time else numbers


def plot_fields(topic: TopicInfo) -> list[str]:
    """Return the fields that are plotted if none are named: the first measurements of the topic."""
    columns = [column for column in topic_columns(topic.schema) if "[]" not in column.path]
    scalars = [column.path for column in columns if _is_scalar(column.type) and _is_measurement(column)]
    lists = [column.path for column in columns if _is_plotted_list(column.type) and _is_measurement(column)]
    return (scalars or lists)[:MAX_DEFAULT]


def read_series(
    topic: TopicInfo,
    fields: Sequence[str],
    *,
    max_points: int = 4_000,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> list[Series]:
    """Return the fields over time, from `start_ns` (inclusive) to `end_ns` (exclusive).

    A field is a column (`acceleration.z`), an item of a list (`positions[2]`), a list, or a struct, which stands for its
    measurements. Of about `max_points / 2` equal groups of rows, the smallest and the largest value are kept.

    Raises:
        ViewError: A field does not exist or has no numbers; the hint names existing ones.
    """
    series_fields = [field for name in fields for field in _expanded(topic, name)]
    names = dict.fromkeys([topic.schema.names[0], *(field.column.name for field in series_fields)])
    schema = pa.schema([topic.schema.field(name) for name in names])
    group = max(1, 2 * topic.rows // max(2, max_points))
    envelopes = [_Envelope(group) for _ in series_fields]
    for batch in scan(topic.segments, schema, Window(start_ns, end_ns)):
        times = batch.column(0).to_numpy()
        for field, envelope in zip(series_fields, envelopes, strict=True):
            envelope.add(times, field.values(batch))
    tag = topic.ontology.tag
    return [
        Series(
            field.label,
            "s" if field.column.is_time else column_unit(tag, field.column.path),
            *envelope.points(),
        )
        for field, envelope in zip(series_fields, envelopes, strict=True)
    ]


class _Envelope:
    """The smallest and the largest value of each `group` consecutive rows."""

    def __init__(self, group: int) -> None:
        self._group = group
        self._times: list[npt.NDArray[np.int64]] = []
        self._values: list[npt.NDArray[np.float64]] = []
        self._rest: tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]] = np.empty(0, np.int64), np.empty(0)

    def add(self, times: npt.NDArray[np.int64], values: npt.NDArray[np.float64]) -> None:
        times, values = np.concatenate((self._rest[0], times)), np.concatenate((self._rest[1], values))
        complete = len(times) // self._group * self._group
        self._keep(times[:complete], values[:complete], self._group)
        self._rest = times[complete:], values[complete:]

    def points(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
        if len(self._rest[0]):
            self._keep(*self._rest, len(self._rest[0]))
        self._rest = np.empty(0, np.int64), np.empty(0)
        return np.concatenate([np.empty(0, np.int64), *self._times]), np.concatenate(
            [np.empty(0), *self._values]
        )

    def _keep(self, times: npt.NDArray[np.int64], values: npt.NDArray[np.float64], group: int) -> None:
        if group > 2:  # noqa: PLR2004 - two rows are their own extremes
            groups = values.reshape(-1, group)
            low = np.where(np.isnan(groups), np.inf, groups).argmin(axis=1)
            high = np.where(np.isnan(groups), -np.inf, groups).argmax(axis=1)
            starts = np.arange(len(groups)) * group
            rows = np.unique(np.concatenate((starts + low, starts + high)))
            times, values = times[rows], values[rows]
        self._times.append(times)
        self._values.append(values)


def _expanded(topic: TopicInfo, name: str) -> Iterator[_Field]:
    """Yield the fields that a name stands for."""
    columns = {column.path: column for column in topic_columns(topic.schema) if "[]" not in column.path}
    item = _ITEM.fullmatch(name)
    if item is not None and item[1] in columns and _is_plotted_list(columns[item[1]].type):
        yield _Field(columns[item[1]], int(item[2]))
        return
    column = columns.get(name)
    if column is not None and _is_scalar(column.type):
        yield _Field(column)
        return
    if column is not None and _is_plotted_list(column.type):
        rows = first_rows(topic, 1, columns=[column.name])
        values = column.values(rows.to_batches()[0])[0].as_py() if rows.num_rows else None
        yield from (_Field(column, at) for at in range(min(len(values or ()), MAX_ITEMS)))
        return
    members = [
        each for path, each in columns.items() if path.startswith(f"{name}.") and _is_scalar(each.type)
    ]
    measurements = [each for each in members if _is_measurement(each)] or members
    if not measurements:
        paths = [
            path for path, each in columns.items() if _is_scalar(each.type) or _is_plotted_list(each.type)
        ]
        problem = "has no numbers" if column is not None else "does not exist"
        raise ViewError(
            f"the field {name!r} {problem}",
            where=f"{topic.sequence}{topic.name}",
            hint=suggest_names([path for path in paths if _is_measurement(columns[path])], [name]),
        )
    yield from map(_Field, measurements)


def _is_scalar(kind: pa.DataType) -> bool:
    return is_number(kind) or pt.is_boolean(kind)


def _is_plotted_list(kind: pa.DataType) -> bool:
    return is_list(kind) and _is_scalar(cast("pa.ListType[Any]", kind).value_type)


def _is_measurement(column: Column) -> bool:
    return not column.is_time and not _METADATA.intersection(column.steps)


def _items(lists: pa.Array[Any], at: int) -> pa.Array[Any]:
    """Return the item at a position of each list; null where a list is null or too short."""
    if pt.is_fixed_size_list(lists.type):
        size = lists.type.list_size
        starts = (np.arange(len(lists)) + lists.offset) * size
        lengths = np.where(np.asarray(lists.is_valid()), size, 0)
    else:
        offsets = cast("pa.ListArray[Any]", lists).offsets.to_numpy()
        starts, lengths = offsets[:-1], np.diff(offsets) * np.asarray(lists.is_valid())
    rows: Any = pa.array(starts + at, mask=at >= lengths)
    return cast("pa.ListArray[Any]", lists).values.take(rows)
