"""The adapters of `nav_msgs`, as in the official SDK."""

from mosaico_ingest.adapters import (
    GridCellsAdapter,
    MapMetadataAdapter,
    OccupancyGridAdapter,
    OdometryAdapter,
    RobotPathAdapter,
)

__all__ = [
    "GridCellsAdapter",
    "MapMetadataAdapter",
    "OccupancyGridAdapter",
    "OdometryAdapter",
    "RobotPathAdapter",
]
