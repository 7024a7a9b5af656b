"""Drawings of stored topics: pictures, maps and plots."""

from __future__ import annotations

import base64
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
from mosaico_ingest.display import time_text
from mosaico_ingest.images import Pixels, jpeg_file
from mosaico_ingest.pages.design import pack
from mosaico_ingest.view.columns import Column, is_list, is_number, topic_columns
from mosaico_ingest.view.pictures import grid_step, has_images, png_bytes, thumbnails
from mosaico_ingest.view.series import Series, read_series
from mosaico_ingest.view.tracks import Track, local_meters

IMAGES = 12
"""Thumbnails of a camera topic."""
CLOUDS = 4
"""Pictures of a point cloud topic."""
HEIGHT = 160
"""Height of a thumbnail, in pixels."""
WIDTH = 400
"""Largest width of a thumbnail, in pixels."""
CLOUD_SIZE = 400
"""Largest width and height of the picture of a point cloud, in pixels."""
QUALITY = 72
"""JPEG quality of thumbnails."""
MAP_WIDTH, MAP_HEIGHT, MARGIN = 400.0, 300.0, 24.0
"""Size and margin of a map, in its own units."""
MAX_MAP_POINTS = 1500
MIN_EXTENT_M = 1.0
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


class Picture(Struct, frozen=True):
    """One picture."""

    source: str
    """A data URL."""
    time: str
    label: str


class Strip(Struct, frozen=True):
    """The pictures of one topic in order of time."""

    topic: str
    pictures: tuple[Picture, ...]
    problems: tuple[str, ...]
    """The reasons why rows could not be shown, without repetitions."""


class Map(Struct, frozen=True):
    """The drawing of a track, to scale; north or the y axis points up."""

    topic: str
    label: str
    caption: str
    path: str
    start: tuple[float, float]
    end: tuple[float, float]
    grid: str
    bar: float
    """Length of the scale bar."""
    bar_label: str


def picture_strip(topic: TopicInfo) -> Strip:
    """Return the pictures of rows at equal distances in time, with the reason for each picture that cannot be shown."""
    is_image = has_images(topic.schema)
    if is_image:
        previews = thumbnails(topic, IMAGES, width=WIDTH, height=HEIGHT)
    else:
        previews = thumbnails(topic, CLOUDS, width=CLOUD_SIZE, height=CLOUD_SIZE)
    pictures: list[Picture] = []
    for each in previews:
        if each.pixels is not None:
            source = _jpeg_url(each.pixels) if is_image else _png_url(each.pixels)
            time = time_text(each.time_ns)
            pictures.append(Picture(source, time.partition(" ")[2], f"{topic.name} at {time} UTC"))
    problems = dict.fromkeys(each.problem for each in previews if each.problem is not None)
    return Strip(topic.name, tuple(pictures), tuple(problems))


def draw_map(track: Track) -> Map | None:
    """Return the map of a track; None if it has fewer than two different positions."""
    meters = local_meters(track)
    meters = meters[np.isfinite(meters).all(axis=1)]
    if not len(meters) or (meters == meters[0]).all():
        return None
    every = -(-len(meters) // MAX_MAP_POINTS)
    points = np.concatenate((meters[::every], meters[-1:]))
    low, high = points.min(axis=0), points.max(axis=0)
    extent = np.maximum(high - low, MIN_EXTENT_M)
    scale = min((MAP_WIDTH - 2 * MARGIN) / extent[0], (MAP_HEIGHT - 2 * MARGIN) / extent[1])
    center = (low + high) / 2
    drawn = np.stack(
        (
            MAP_WIDTH / 2 + (points[:, 0] - center[0]) * scale,
            MAP_HEIGHT / 2 - (points[:, 1] - center[1]) * scale,
        ),
        axis=1,
    )
    step = grid_step(float(extent.max()))
    length = float(np.hypot(*np.diff(meters, axis=0).T).sum())
    unit = "east by north" if track.is_gps else "along x by along y"
    size = f"{_meters(high[0] - low[0])} by {_meters(high[1] - low[1])} ({unit})"
    frame = f", frame {track.frame_id}" if track.frame_id and not track.is_gps else ""
    return Map(
        topic=track.topic,
        label=f"Track of {track.topic} from above: {size}",
        caption=f"{size}, length {_meters(length)}{frame}",
        path=_path(drawn),
        start=_pair(drawn[0]),
        end=_pair(drawn[-1]),
        grid=_grid(step * scale),
        bar=round(step * scale, 1),
        bar_label=_meters(step),
    )


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


def _path(points: np.typing.NDArray[np.float64]) -> str:
    """Return a path of the points without repetitions."""
    texts = [f"{x:.1f} {y:.1f}" for x, y in points.tolist()]
    vertices = [text for at, text in enumerate(texts) if not at or text != texts[at - 1]]
    return f"M{'L'.join(vertices)}" if len(vertices) > 1 else ""


def _grid(step: float) -> str:
    columns = np.arange(MAP_WIDTH / 2 % step, MAP_WIDTH, step)
    rows = np.arange(MAP_HEIGHT / 2 % step, MAP_HEIGHT, step)
    lines = [f"M{x:.1f} 0V{MAP_HEIGHT:g}" for x in columns.tolist()]
    return "".join((*lines, *(f"M0 {y:.1f}H{MAP_WIDTH:g}" for y in rows.tolist())))


def _pair(point: Sequence[float] | np.typing.NDArray[np.float64]) -> tuple[float, float]:
    return (round(float(point[0]), 1), round(float(point[1]), 1))


def _meters(length: float) -> str:
    if length >= 1000:  # noqa: PLR2004 - a kilometer
        return f"{length / 1000:.4g} km"
    return f"{length:.3g} m" if length >= 1 or not length else f"{length * 100:.3g} cm"


def _jpeg_url(pixels: Pixels) -> str:
    return _url("jpeg", jpeg_file(pixels, quality=QUALITY))


def _png_url(pixels: Pixels) -> str:
    return _url("png", png_bytes(pixels))


def _url(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


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
