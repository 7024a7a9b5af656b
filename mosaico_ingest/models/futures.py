"""The models that the official SDK keeps apart as provisional, as in `mosaicolabs.models.futures`."""

from mosaico_ingest.ontology import (
    GridCells,
    LaserScan,
    Lidar,
    MapMetadata,
    MultiEchoLaserScan,
    OccupancyGrid,
    Radar,
    RGBDCamera,
    StereoCamera,
    ToFCamera,
)

__all__ = [
    "GridCells",
    "LaserScan",
    "Lidar",
    "MapMetadata",
    "MultiEchoLaserScan",
    "OccupancyGrid",
    "RGBDCamera",
    "Radar",
    "StereoCamera",
    "ToFCamera",
]
