"""The picture of a row: of an image, of a point cloud from above, or of an occupancy grid."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from msgspec import Struct

from mosaico_ingest.destinations.store.model import TopicInfo
from mosaico_ingest.errors import ViewError
from mosaico_ingest.view.clouds import from_above, grid_pixels, has_grid, has_points, row_points
from mosaico_ingest.view.images import Pixels, decode_image, fit_pixels, has_images
from mosaico_ingest.view.rows import rows_near


class Thumbnail(Struct, frozen=True):
    """A small picture of one row, or the reason why there is none."""

    time_ns: int
    offset_s: float
    """Seconds after the first row of the topic."""
    pixels: Pixels | None
    problem: str | None


def has_pictures(topic: TopicInfo) -> bool:
    """Return whether the rows of a topic can be shown as pictures."""
    return has_images(topic.schema) or has_points(topic.schema) or has_grid(topic.schema)


def row_picture(topic: TopicInfo, row: Mapping[str, Any], *, size: int = 800) -> Pixels:
    """Return the picture of a row as RGB pixels; point clouds have at most `size` x `size` pixels.

    Raises:
        ViewError: The rows of the topic are no pictures, or this one is invalid.
        IngestError: Pillow is required and not installed.
    """
    if has_images(topic.schema):
        return decode_image(row, ros_format=str(topic.metadata.get("ros_format", "")))
    if has_points(topic.schema):
        return from_above(row_points(row), size=size)
    if has_grid(topic.schema):
        return grid_pixels(row)
    raise ViewError(
        f"rows of {topic.ontology.tag} are no pictures",
        where=f"{topic.sequence}{topic.name}",
        hint="choose a topic with images, point clouds, laser scans or grids",
    )


def thumbnails(topic: TopicInfo, count: int, *, size: int = 320) -> list[Thumbnail]:
    """Return small pictures of `count` rows at equal distances in time, read one after the other.

    A row that cannot be shown has the reason instead of a picture.

    Raises:
        ViewError: The rows of the topic are no pictures.
        IngestError: Pillow is not installed.
    """
    if topic.start_ns is None or topic.end_ns is None:
        return []
    if not has_pictures(topic):
        row_picture(topic, {})
    start_ns, span_ns = topic.start_ns, topic.end_ns - topic.start_ns
    shares = np.linspace(0, 1, count) if count > 1 else np.zeros(1)
    pictures: dict[int, Thumbnail] = {}
    for at_ns in (start_ns + round(share * span_ns) for share in shares):
        row = rows_near(topic, [at_ns]).to_pylist()[0]
        time_ns = row[topic.schema.names[0]]
        if time_ns not in pictures:
            pixels, problem = _thumbnail(topic, row, size)
            pictures[time_ns] = Thumbnail(time_ns, (time_ns - start_ns) / 1e9, pixels, problem)
    return list(pictures.values())


def _thumbnail(topic: TopicInfo, row: Mapping[str, Any], size: int) -> tuple[Pixels | None, str | None]:
    try:
        pixels = row_picture(topic, row, size=size)
    except ViewError as error:
        return None, str(error)
    return fit_pixels(pixels, width=size, height=size), None
