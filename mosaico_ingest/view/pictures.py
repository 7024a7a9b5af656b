"""The picture of a row: of an image, of a point cloud from above, or of an occupancy grid."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mosaico_ingest.destinations.store.model import TopicInfo
from mosaico_ingest.errors import ViewError
from mosaico_ingest.view.clouds import from_above, grid_pixels, has_grid, has_points, row_points
from mosaico_ingest.view.images import Pixels, decode_image, has_images

__all__ = ["has_pictures", "row_picture"]


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
