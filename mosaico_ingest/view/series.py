"""Scalar fields of a topic over time, and charts of them as text and as picture files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.types as pt
from msgspec import Struct

from mosaico_ingest.destinations.store.model import TopicInfo
from mosaico_ingest.destinations.store.store import Window, scan
from mosaico_ingest.display import seconds_text, time_text
from mosaico_ingest.errors import ViewError, missing_library
from mosaico_ingest.findings import suggest_names
from mosaico_ingest.ontology.registry import column_unit
from mosaico_ingest.view.columns import Column, is_list, is_number, topic_columns
from mosaico_ingest.view.pictures import require_suffix
from mosaico_ingest.view.rows import column_schema, first_rows

MAX_ITEMS = 8
"""Items of a list that are plotted if the field does not select one."""
MAX_DEFAULT = 6
"""Fields that are plotted if none are named."""
_ITEM = re.compile(r"(.+)\[(\d+)\]")
_METADATA = frozenset(
    {"header", "covariance", "covariance_type", "variance", "variance_type", "timestamp_ns"}
)
"""Parts of a path whose values are not measurements."""
_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]], np.uint8)
"""The bit of each of the 4 x 2 dots of a Braille character."""
_BRAILLE = 0x2800
_LABEL = 11
"""Characters of the values beside the axis."""
_SUFFIXES = (".png", ".svg", ".pdf", ".jpg", ".jpeg", ".webp")


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
    schema = column_schema(topic, (field.column.name for field in series_fields))
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


class ChartLine(Struct, frozen=True):
    """A line of a chart in text: the label of the axis, then cells with the number of the series that is drawn there."""

    label: str
    text: str
    owners: tuple[int, ...]
    """The position of the series for each character of `text`; -1 without one."""


def chart_lines(series: Sequence[Series], *, width: int, height: int) -> list[ChartLine]:
    """Return a chart of Braille dots with `height` lines of at most `width` characters; empty without finite values."""
    columns = max(10, width - _LABEL - 2)
    finite = [np.isfinite(each.values) for each in series]
    if not any(mask.any() for mask in finite):
        return []
    values = [each.values[mask] for each, mask in zip(series, finite, strict=True)]
    times = [each.times_ns[mask] for each, mask in zip(series, finite, strict=True)]
    low, high = _range(values)
    start_ns, end_ns = (
        min(int(each[0]) for each in times if len(each)),
        max(int(each[-1]) for each in times if len(each)),
    )
    cells = np.zeros((height, columns), np.uint8)
    owners = np.full((height, columns), -1)
    for number, (moments, numbers) in enumerate(zip(times, values, strict=True)):
        x = (moments - start_ns) / max(1, end_ns - start_ns) * (columns * 2 - 1)
        y = (high - numbers) / (high - low) * (height * 4 - 1)
        for row, column in _dots(x, y):
            cells[row // 4, column // 2] |= _DOTS[row % 4, column % 2]
            owners[row // 4, column // 2] = number
    labels = {
        0: high,
        height - 1: low,
        (height - 1) // 2: high + (low - high) * ((height - 1) // 2) / (height - 1),
    }
    lines = [
        ChartLine(
            f"{f'{labels[row]:.4g}' if row in labels else '':>{_LABEL}} ┤",
            "".join(chr(_BRAILLE + int(cell)) if cell else " " for cell in cells[row]),
            tuple(int(owner) for owner in owners[row]),
        )
        for row in range(height)
    ]
    first, last = time_text(start_ns), f"+{seconds_text((end_ns - start_ns) / 1e9)}"
    if len(first) + len(last) >= columns:
        first = first.partition(" ")[2]  # the time without the date
    axis = f"{first}{last:>{max(1, columns - len(first))}}"
    return [*lines, ChartLine(" " * (_LABEL + 2), axis, (-1,) * len(axis))]


def write_chart(series: Sequence[Series], path: Path, *, title: str) -> None:
    """Write a chart with a panel for each unit, as PNG, SVG, PDF, JPEG or WebP by the suffix of the file.

    Raises:
        ViewError: The suffix is unknown.
        IngestError: Matplotlib is not installed.
    """
    require_suffix(path, _SUFFIXES)
    try:
        from matplotlib.figure import Figure  # noqa: PLC0415 - an optional library
    except ImportError as error:
        raise missing_library("Matplotlib", "plot") from error
    units = list(dict.fromkeys(each.unit for each in series))
    figure: Any = Figure(figsize=(10, 1.2 + 2.6 * len(units)), layout="constrained")
    figure.suptitle(title)
    panels = figure.subplots(len(units), 1, sharex=True, squeeze=False)[:, 0]
    start_ns = min((int(each.times_ns[0]) for each in series if len(each.times_ns)), default=0)
    for unit, panel in zip(units, panels, strict=True):
        for each in series:
            if each.unit == unit:
                seconds = (each.times_ns - start_ns) / 1e9
                marker = "." if len(seconds) < 50 else ""  # noqa: PLR2004 - few points are hard to see as a line
                panel.plot(seconds, each.values, linewidth=1, marker=marker, label=each.label)
        panel.set_ylabel(unit)
        panel.grid(visible=True, alpha=0.3)
        panel.legend(loc="upper right", fontsize="small")
    panels[-1].set_xlabel(f"s after {time_text(start_ns)} UTC")
    figure.savefig(path, dpi=120)


def _range(values: Sequence[npt.NDArray[np.float64]]) -> tuple[float, float]:
    numbers = np.concatenate(values)
    low, high = float(numbers.min()), float(numbers.max())
    if high > low:
        return low, high
    margin = abs(low) / 10 or 1.0
    return low - margin, high + margin


def _dots(x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return the row and column of each dot on the lines between consecutive points."""
    if len(x) == 1:
        return [(round(y[0]), round(x[0]))]
    steps = np.ceil(np.maximum(np.abs(np.diff(x)), np.abs(np.diff(y)))).astype(np.int64) + 1
    starts = np.repeat(np.arange(len(steps)), steps)
    share = (np.arange(len(starts)) - np.repeat(np.cumsum(steps) - steps, steps)) / np.repeat(
        np.maximum(steps - 1, 1), steps
    )
    columns = np.rint(x[starts] + share * (x[starts + 1] - x[starts])).astype(int)
    rows = np.rint(y[starts] + share * (y[starts + 1] - y[starts])).astype(int)
    return list(dict.fromkeys(zip(rows.tolist(), columns.tolist(), strict=True)))
