"""This file is maps made of cells."""

from __future__ import annotations

from mosaico_ingest.ontology.fields import Float32, Int8, UInt32
from mosaico_ingest.ontology.geometry import Point3d, Pose
from mosaico_ingest.ontology.header import Stamped, Time
from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["GridCells", "MapMetadata", "OccupancyGrid"]


class MapMetadata(Serializable):
    """Where a map lies and how fine it is."""

    map_load_time: Time
    """When it was loaded."""
    resolution: Float32
    """Side of a cell, m."""
    width: UInt32
    """cells."""
    height: UInt32
    """cells."""
    origin: Pose
    """Of the corner of cell (0, 0), in the header's frame."""


class OccupancyGrid(Stamped, Serializable):
    """How likely each cell is taken."""

    info: MapMetadata
    """Where it lies."""
    data: list[Int8]
    """Row by row from (0, 0): 0 to 100 percent, -1 not known."""


class GridCells(Stamped, Serializable):
    """Some cells of a grid."""

    cell_width: Float32
    """m."""
    cell_height: Float32
    """m."""
    cells: list[Point3d]
    """Their centres, m."""
