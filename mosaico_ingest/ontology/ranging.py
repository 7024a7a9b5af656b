"""Range sensors, laser scanners, radar, depth cameras, point clouds and grids."""

from __future__ import annotations

from enum import IntEnum

from pydantic import model_validator
from typing_extensions import Self

from mosaico_ingest.ontology.geometry import Point3d, Pose, Varying
from mosaico_ingest.ontology.header import Stamped, Time
from mosaico_ingest.ontology.model import (
    Float32,
    Float64,
    Int8,
    Serializable,
    UInt8,
    UInt16,
    UInt32,
)

__all__ = [
    "Cloud",
    "GridCells",
    "LaserScan",
    "Lidar",
    "MapMetadata",
    "MultiEchoLaserScan",
    "OccupancyGrid",
    "PointCloud2",
    "PointField",
    "PointFieldDataType",
    "RGBDCamera",
    "Radar",
    "Range",
    "StereoCamera",
    "ToFCamera",
]


class Cloud(Stamped):
    """Points as lists of the same length, one for each coordinate."""

    x: list[Float32]
    """m."""
    y: list[Float32]
    """m."""
    z: list[Float32]
    """m."""


class PointFieldDataType(IntEnum):
    """The type of one value of a record."""

    INT8 = 1
    UINT8 = 2
    INT16 = 3
    UINT16 = 4
    INT32 = 5
    UINT32 = 6
    FLOAT32 = 7
    FLOAT64 = 8


class PointField(Serializable):
    """One field of a record."""

    name: str
    """As `x`."""
    offset: UInt32
    """bytes from the start of the record."""
    datatype: PointFieldDataType
    """What a value is."""
    count: UInt32
    """How many values."""


class PointCloud2(Stamped, Serializable):
    """Points row by row, each a record of `point_step` bytes."""

    height: UInt32
    """rows; 1 of a cloud without order."""
    width: UInt32
    """points a row."""
    fields: list[PointField]
    """What a record holds."""
    is_bigendian: bool
    """Byte order of the records."""
    point_step: UInt32
    """bytes a point."""
    row_step: UInt32
    """bytes a row."""
    data: bytes
    """`row_step` times `height` bytes."""
    is_dense: bool
    """Whether every point is valid."""


class _Coloured(Cloud):
    rgb: list[Float32] | None = None
    """The colour, packed into the bits of a float as 0x00rrggbb."""
    intensity: list[Float32] | None = None
    """Brightness, in the sensor's unit."""


class RGBDCamera(_Coloured, Serializable):
    """A cloud from structured light."""


class ToFCamera(_Coloured, Serializable):
    """A cloud from the time light takes."""

    noise: list[Float32] | None = None
    """Of the distance, in the sensor's unit."""
    grayscale: list[Float32] | None = None
    """Brightness under the camera's own light."""


class StereoCamera(_Coloured, Serializable):
    """A cloud from two pictures."""

    luma: list[UInt8] | None = None
    """Brightness of the pixel."""
    cost: list[UInt8] | None = None
    """Of the match: 0 is certain."""


class _Sweep(Stamped):
    """One turn of the beam."""

    angle_min: Float32
    """Of the first beam, rad."""
    angle_max: Float32
    """Of the last beam, rad."""
    angle_increment: Float32
    """From one beam to the next, rad."""
    time_increment: Float32
    """From one beam to the next, s."""
    scan_time: Float32
    """From one scan to the next, s."""
    range_min: Float32
    """Anything nearer is no measurement, m."""
    range_max: Float32
    """Anything farther is no measurement, m."""


class LaserScan(_Sweep, Serializable):
    """One distance a beam."""

    ranges: list[Float32]
    """m."""
    intensities: list[Float32] | None = None
    """In the sensor's unit; null where it gives none."""


class MultiEchoLaserScan(_Sweep, Serializable):
    """Several distances a beam."""

    ranges: list[list[Float32]]
    """The echoes of each beam, m."""
    intensities: list[list[Float32]] | None = None
    """The echoes of each beam, in the sensor's unit; null where it gives none."""


class Lidar(Cloud, Serializable):
    """A cloud and what the sensor says of each point; null where it says nothing."""

    intensity: list[Float32] | None = None
    """Strength of the return, in the sensor's unit."""
    reflectivity: list[UInt16] | None = None
    """Of the surface, in the sensor's unit."""
    beam_id: list[UInt16] | None = None
    """Which laser; also called ring or channel."""
    range: list[Float32] | None = None
    """Distance, m."""
    near_ir: list[Float32] | None = None
    """Ambient near-infrared light, in the sensor's unit."""
    azimuth: list[Float32] | None = None
    """rad."""
    elevation: list[Float32] | None = None
    """rad."""
    confidence: list[UInt8] | None = None
    """In the sensor's unit."""
    return_type: list[UInt8] | None = None
    """Which return of the pulse: first, strongest, last, in the sensor's code."""
    point_timestamp: list[Float64] | None = None
    """When the point was measured, in the sensor's unit and from its start."""


class Radar(Cloud, Serializable):
    """Detections and what the sensor says of each; null where it says nothing."""

    range: list[Float32] | None = None
    """Distance, m."""
    azimuth: list[Float32] | None = None
    """rad."""
    elevation: list[Float32] | None = None
    """rad."""
    rcs: list[Float32] | None = None
    """Radar cross-section, dBm²."""
    snr: list[Float32] | None = None
    """Signal to noise, dB."""
    doppler_velocity: list[Float32] | None = None
    """Along the beam, m/s."""
    vx: list[Float32] | None = None
    """m/s."""
    vy: list[Float32] | None = None
    """m/s."""
    vx_comp: list[Float32] | None = None
    """`vx` without the sensor's own motion, m/s."""
    vy_comp: list[Float32] | None = None
    """`vy` without the sensor's own motion, m/s."""
    ax: list[Float32] | None = None
    """m/s²."""
    ay: list[Float32] | None = None
    """m/s²."""
    radial_speed: list[Float32] | None = None
    """Away from the sensor, m/s."""


class Range(Stamped, Varying, Serializable):
    """One distance, which lies between the sensor's bounds."""

    radiation_type: UInt8
    """0 ultrasound, 1 infrared."""
    field_of_view: Float32
    """The cone's full angle, rad."""
    min_range: Float32
    """m."""
    max_range: Float32
    """m."""
    range: Float32
    """m."""

    @model_validator(mode="after")
    def _lies_between(self) -> Self:
        if not self.min_range <= self.range <= self.max_range:
            raise ValueError(
                f"range {self.range} is not between min_range {self.min_range} and max_range {self.max_range}"
            )
        return self


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
