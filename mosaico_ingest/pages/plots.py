"""Plots of scalar fields: related fields in one plot, as compact data for the plotting library."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.types as pt
from markupsafe import Markup
from msgspec import Struct

from mosaico_ingest.destinations.store.model import TopicInfo
from mosaico_ingest.pages.design import pack
from mosaico_ingest.view.columns import Column, is_list, is_number, topic_columns
from mosaico_ingest.view.series import Series, read_series

MAX_SERIES = 8
"""Series in one plot."""
MAX_PLOTS = 24
"""Plots of one topic."""
MAX_COLUMNS = 120
"""Columns of a topic that are read for plots."""
DIGITS = 6
"""Significant digits of the values."""
MEMBER = re.compile(r"(?:\.[xyzw]|\[\d+\])$")
"""The end of a path that distinguishes the fields of one plot."""

MAX_POINTS = 600
"""Points of one series; if a topic has more rows, the extremes of groups of rows."""
UNPLOTTED = {"header", "covariance", "covariance_type", "variance_type"}
"""Names of fields that are not plotted, wherever they are."""
SEPARATE = {"°"}
"""Units of fields whose values differ too much for one plot: latitude and longitude."""


class Plot(Struct, frozen=True):
    """A plot of related fields."""

    title: str
    """The common part of the paths."""
    label: str
    """A description in words, for people who cannot see the plot."""


class TopicPlots(Struct, frozen=True):
    """The plots of one topic."""

    topic: str
    plots: tuple[Plot, ...]
    content: Markup
    """The data of all plots, packed."""
    omitted: int
    """Number of series that are not shown."""
    constant: tuple[str, ...]
    """Fields that have the same value in all rows, with the value."""


def plotted_columns(topic: TopicInfo) -> list[Column]:
    """Return the columns that can be plotted: numbers and lists of numbers, except those of headers and covariances."""
    return [
        column
        for column in topic_columns(topic.schema)
        if "[]" not in column.path
        and not column.is_time
        and not UNPLOTTED.intersection(column.steps)
        and _is_numeric(column.type)
    ]


def topic_plots(topic: TopicInfo, start_ns: int) -> TopicPlots | None:
    """Return the plots of a topic, or None if it has no numbers that change.

    Times are relative to `start_ns`. Fields that never change are listed instead of plotted.
    """
    columns = plotted_columns(topic)
    series = read_series(topic, [column.path for column in columns[:MAX_COLUMNS]], max_points=MAX_POINTS)
    constant: list[str] = []
    groups: dict[tuple[str, str], list[Series]] = {}
    for one in series:
        finite = one.values[np.isfinite(one.values)]
        if not len(finite):
            continue
        unit = one.unit
        if (finite == finite[0]).all():
            constant.append(f"{one.label} = {finite[0]:.{DIGITS}g}{f' {unit}' if unit else ''}")
        else:
            title = one.label if unit in SEPARATE else MEMBER.sub("", one.label)
            groups.setdefault((title, unit), []).append(one)
    plots = list(_plots(groups, start_ns))[:MAX_PLOTS]
    if not plots:
        return None
    series_count = sum(len(members[:MAX_SERIES]) for members in list(groups.values())[:MAX_PLOTS])
    omitted = sum(map(len, groups.values())) - series_count + len(columns[MAX_COLUMNS:])
    content = pack([data for _, data in plots])
    return TopicPlots(topic.name, tuple(plot for plot, _ in plots), content, omitted, tuple(constant))


def _plots(groups: dict[tuple[str, str], list[Series]], start_ns: int) -> Iterable[tuple[Plot, str]]:
    for (title, unit), members in groups.items():
        series = members[:MAX_SERIES]
        words = ", ".join(
            f"{one.label} from {_text(np.nanmin(one.values))} to {_text(np.nanmax(one.values))}"
            for one in series
        )
        data = {"unit": unit, "tables": [_table(one, title, start_ns) for one in series]}
        full_title = f"{title} ({unit})" if unit else title
        yield Plot(full_title, f"Plot over time: {words}"), json.dumps(data, separators=(",", ":"))


def _table(series: Series, title: str, start_ns: int) -> dict[str, object]:
    """Return name, times in s and values of a series."""
    name = series.label.removeprefix(title).lstrip(".") or title
    seconds = np.round((series.times_ns - start_ns) / 1e9, 6)
    return {"name": name, "x": seconds.tolist(), "y": _numbers(series.values)}


def _numbers(values: Sequence[float] | np.typing.NDArray[np.float64]) -> list[float | None]:
    """Return the values with a limited number of digits; None for NaN and infinity."""
    return [
        json.loads(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
        for value in np.asarray(values).tolist()
    ]


def _text(value: float) -> str:
    return f"{value:.{DIGITS}g}"


def _is_numeric(kind: pa.DataType) -> bool:
    if is_list(kind):
        kind = getattr(kind, "value_type")  # noqa: B009 - the stubs do not know the class
    return is_number(kind) or pt.is_boolean(kind)
