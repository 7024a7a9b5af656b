"""Pictures on pages: thumbnails of cameras along the time axis, point clouds from above, and maps of tracks to scale."""

from __future__ import annotations

import base64
from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from mosaico_ingest.destinations.store.model import TopicInfo
from mosaico_ingest.images.files import jpeg_file
from mosaico_ingest.report.units import time_text
from mosaico_ingest.view.pictures import Pixels, grid_step, has_images, png_bytes, thumbnails
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
