"""The picture of a row: of an image, of a point cloud from above, or of an occupancy grid."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from msgspec import Struct

from mosaico_ingest.destinations.store.model import TopicInfo
from mosaico_ingest.errors import ViewError
from mosaico_ingest.view.clouds import from_above, grid_pixels, has_grid, has_points, row_points
from mosaico_ingest.view.images import Pixels, decode_image, fit_pixels, has_images
from mosaico_ingest.view.rows import nearest_row, rows_near
from mosaico_ingest.view.video import video_codec, video_frames


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

    The picture of a packet of a video is its frame, for which the packets since the last key frame are read.

    Raises:
        ViewError: The rows of the topic are no pictures, or this one is invalid.
        IngestError: Pillow or PyAV is required and not installed.
    """
    if has_images(topic.schema):
        codec = row_codec(topic, row)
        if codec is None:
            return decode_image(row, ros_format=_ros_format(topic))
        ((_, picture),) = video_frames(topic, codec, [row[topic.schema.names[0]]])
        if isinstance(picture, ViewError):
            raise picture
        return picture
    if has_points(topic.schema):
        return from_above(row_points(row), size=size)
    if has_grid(topic.schema):
        return grid_pixels(row)
    raise ViewError(
        f"rows of {topic.ontology.tag} are no pictures",
        where=f"{topic.sequence}{topic.name}",
        hint="choose a topic with images, point clouds, laser scans or grids",
    )


def row_codec(topic: TopicInfo, row: Mapping[str, Any]) -> str | None:
    """Return the codec of a packet of a video, such as `h264`, or None for other images."""
    return video_codec(row.get("encoding"), row.get("format"), _ros_format(topic))


def thumbnails(topic: TopicInfo, count: int, *, width: int, height: int) -> list[Thumbnail]:
    """Return pictures of `count` rows at equal distances in time, scaled to fit into `width` x `height`.

    A row that cannot be shown has the reason instead of a picture. Rows are read one after the other.

    Raises:
        ViewError: The rows of the topic are no pictures.
        IngestError: Pillow or PyAV is required and not installed.
    """
    if topic.start_ns is None or topic.end_ns is None:
        return []
    if not has_pictures(topic):
        row_picture(topic, {})
    times_ns = np.linspace(0, topic.end_ns - topic.start_ns, count).round().astype(np.int64) + topic.start_ns
    result: list[Thumbnail] = []
    for time_ns, picture in _pictures(topic, times_ns.tolist(), size=max(width, height)):
        offset_s = (time_ns - topic.start_ns) / 1e9
        if isinstance(picture, ViewError):
            result.append(Thumbnail(time_ns, offset_s, None, str(picture)))
        else:
            pixels = fit_pixels(picture, width=width, height=height)
            result.append(Thumbnail(time_ns, offset_s, pixels, None))
    return sorted(result, key=lambda each: each.time_ns)


def _pictures(
    topic: TopicInfo, times_ns: Sequence[int], *, size: int
) -> Iterator[tuple[int, Pixels | ViewError]]:
    """Yield the time and the picture, or the reason why there is none, of the row nearest to each time."""
    name = topic.schema.names[0]
    row_times: list[int] = rows_near(topic, times_ns, columns=[]).column(name).to_numpy().tolist()
    formats = [each for each in ("encoding", "format") if each in topic.schema.names]
    codec = row_codec(topic, nearest_row(topic, columns=formats) or {}) if has_images(topic.schema) else None
    if codec is not None:
        yield from video_frames(topic, codec, row_times)
        return
    for time_ns in row_times:
        row = nearest_row(topic, time_ns) or {}
        try:
            yield time_ns, row_picture(topic, row, size=size)
        except ViewError as error:
            yield time_ns, error


def _ros_format(topic: TopicInfo) -> str:
    return str(topic.metadata.get("ros_format", ""))
