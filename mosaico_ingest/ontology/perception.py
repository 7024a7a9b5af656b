"""Images, camera calibration, range sensors, laser scanners, radar, point clouds and grids."""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import Annotated

from pydantic import model_validator
from typing_extensions import Self

from mosaico_ingest.ontology.geometry import Point3d, Pose, Varying, Vector2d
from mosaico_ingest.ontology.model import (
    FixedSize,
    Float32,
    Float64,
    Int8,
    Int32,
    Serializable,
    Stamped,
    Time,
    UInt8,
    UInt16,
    UInt32,
)
from mosaico_ingest.ontology.registry import SerializationFormat


class ImageFormat(str, Enum):
    """The encoding of an image's bytes."""

    RAW = "raw"
    PNG = "png"
    JPEG = "jpeg"
    JPG = "jpg"
    TIFF = "tiff"
    H264 = "h264"
    HEVC = "hevc"


class Image(Stamped, Serializable):
    """An image with a known pixel format."""

    __serialization_format__ = SerializationFormat.IMAGE

    data: bytes
    """The image rows of `stride` bytes each, encoded as `format`."""
    format: ImageFormat
    """The encoding of `data`; `png` is a lossless grayscale picture `stride` bytes wide, whatever the pixel encoding."""
    width: Int32
    """Width in pixels."""
    height: Int32
    """Height in pixels."""
    stride: Int32
    """Bytes per image row."""
    encoding: str
    """The pixel encoding, such as `rgb8`."""
    is_bigendian: bool | None = None
    """Byte order of multi-byte pixels."""


class CompressedImage(Stamped, Serializable):
    """A compressed image, or a part of a video stream, as the camera sent it."""

    __serialization_format__ = SerializationFormat.IMAGE

    data: bytes
    """The compressed bytes, unchanged."""
    format: ImageFormat
    """The encoding of `data`."""


class ROI(Serializable):
    """A rectangle within an image."""

    offset: Vector2d
    """Upper left corner in pixels."""
    height: UInt32
    """Height in pixels."""
    width: UInt32
    """Width in pixels."""
    do_rectify: bool | None = None
    """Whether the rectangle also applies to the rectified image."""


class CameraInfo(Stamped, Serializable):
    """The calibration of a camera; matrices are in row-major order."""

    height: UInt32
    """Height in pixels at calibration."""
    width: UInt32
    """Width in pixels at calibration."""
    distortion_model: str
    """The distortion model, such as `plumb_bob`."""
    distortion_parameters: list[Float64]
    """The parameters of the distortion model."""
    intrinsic_parameters: Annotated[list[Float64], FixedSize(9)]
    """3 x 3, pixels: focal lengths and principal point of the raw image."""
    rectification_parameters: Annotated[list[Float64], FixedSize(9)]
    """3 x 3: the rotation that aligns the rows of a stereo pair."""
    projection_parameters: Annotated[list[Float64], FixedSize(12)]
    """3 x 4, pixels: projection of the rectified image."""
    binning: Vector2d | None = None
    """Number of sensor pixels combined into one, horizontally and vertically; null without binning."""
    roi: ROI | None = None
    """The part of the sensor in use; null for the complete sensor."""


class Cloud(Stamped):
    """Points as lists of coordinates; all lists have the same length."""

    x: list[Float32]
    """m."""
    y: list[Float32]
    """m."""
    z: list[Float32]
    """m."""


class PointFieldDataType(IntEnum):
    """The type of one value of a point."""

    INT8 = 1
    UINT8 = 2
    INT16 = 3
    UINT16 = 4
    INT32 = 5
    UINT32 = 6
    FLOAT32 = 7
    FLOAT64 = 8


class PointField(Serializable):
    """One field of the points of a `PointCloud2`."""

    name: str
    """The name of the field, such as `x`."""
    offset: UInt32
    """Byte offset from the start of a point."""
    datatype: PointFieldDataType
    """The type of the values."""
    count: UInt32
    """The number of values."""


class PointCloud2(Stamped, Serializable):
    """A point cloud with its binary layout: rows of points of `point_step` bytes."""

    height: UInt32
    """Number of rows; 1 for an unordered cloud."""
    width: UInt32
    """Number of points per row."""
    fields: list[PointField]
    """The fields of a point."""
    is_bigendian: bool
    """Byte order of the values."""
    point_step: UInt32
    """Bytes per point."""
    row_step: UInt32
    """Bytes per row."""
    data: bytes
    """`row_step` times `height` bytes."""
    is_dense: bool
    """Whether all points are valid."""


class _Colored(Cloud):
    rgb: list[Float32] | None = None
    """The color, packed as 0x00rrggbb into the bits of a float."""
    intensity: list[Float32] | None = None
    """Brightness in the sensor's unit."""


class RGBDCamera(_Colored, Serializable):
    """A point cloud of a structured-light camera."""


class ToFCamera(_Colored, Serializable):
    """A point cloud of a time-of-flight camera."""

    noise: list[Float32] | None = None
    """Noise of the distance in the sensor's unit."""
    grayscale: list[Float32] | None = None
    """Brightness under the camera's own illumination."""


class StereoCamera(_Colored, Serializable):
    """A point cloud of a stereo camera."""

    luma: list[UInt8] | None = None
    """Brightness of the pixel."""
    cost: list[UInt8] | None = None
    """Matching cost; 0 is certain."""


class _Sweep(Stamped):
    """One sweep of a scanning beam."""

    angle_min: Float32
    """Angle of the first beam, rad."""
    angle_max: Float32
    """Angle of the last beam, rad."""
    angle_increment: Float32
    """Angle between beams, rad."""
    time_increment: Float32
    """Time between beams, s."""
    scan_time: Float32
    """Time between scans, s."""
    range_min: Float32
    """Minimum valid range, m."""
    range_max: Float32
    """Maximum valid range, m."""


class LaserScan(_Sweep, Serializable):
    """A laser scan with one range per beam."""

    ranges: list[Float32]
    """m."""
    intensities: list[Float32] | None = None
    """Intensities in the sensor's unit; null if the sensor has none."""


class MultiEchoLaserScan(_Sweep, Serializable):
    """A laser scan with several echoes per beam."""

    ranges: list[list[Float32]]
    """The echoes of each beam, m."""
    intensities: list[list[Float32]] | None = None
    """The intensities of each beam's echoes, in the sensor's unit; null if the sensor has none."""


class Lidar(Cloud, Serializable):
    """A lidar point cloud with properties per point; null if the sensor does not report them."""

    intensity: list[Float32] | None = None
    """Strength of the return, in the sensor's unit."""
    reflectivity: list[UInt16] | None = None
    """Reflectivity of the surface in the sensor's unit."""
    beam_id: list[UInt16] | None = None
    """The laser that measured the point; also called ring or channel."""
    range: list[Float32] | None = None
    """Distance, m."""
    near_ir: list[Float32] | None = None
    """Ambient near-infrared light in the sensor's unit."""
    azimuth: list[Float32] | None = None
    """rad."""
    elevation: list[Float32] | None = None
    """rad."""
    confidence: list[UInt8] | None = None
    """Confidence in the sensor's unit."""
    return_type: list[UInt8] | None = None
    """The kind of return (first, strongest, last), as a code of the sensor."""
    point_timestamp: list[Float64] | None = None
    """Time of each point, in the sensor's unit and relative to its start."""


class Radar(Cloud, Serializable):
    """Radar detections with properties per detection; null if the sensor does not report them."""

    range: list[Float32] | None = None
    """Distance, m."""
    azimuth: list[Float32] | None = None
    """rad."""
    elevation: list[Float32] | None = None
    """rad."""
    rcs: list[Float32] | None = None
    """Radar cross-section, dBm²."""
    snr: list[Float32] | None = None
    """Signal-to-noise ratio, dB."""
    doppler_velocity: list[Float32] | None = None
    """Velocity along the beam, m/s."""
    vx: list[Float32] | None = None
    """m/s."""
    vy: list[Float32] | None = None
    """m/s."""
    vx_comp: list[Float32] | None = None
    """`vx` compensated for the sensor's own motion, m/s."""
    vy_comp: list[Float32] | None = None
    """`vy` compensated for the sensor's own motion, m/s."""
    ax: list[Float32] | None = None
    """m/s²."""
    ay: list[Float32] | None = None
    """m/s²."""
    radial_speed: list[Float32] | None = None
    """Speed away from the sensor, m/s."""


class Range(Stamped, Varying, Serializable):
    """One distance measurement within the sensor's bounds."""

    radiation_type: UInt8
    """0 for ultrasound, 1 for infrared."""
    field_of_view: Float32
    """Full opening angle of the cone, rad."""
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
    """The position and resolution of a map."""

    map_load_time: Time
    """The time at which the map was loaded."""
    resolution: Float32
    """Side length of a cell, m."""
    width: UInt32
    """cells."""
    height: UInt32
    """cells."""
    origin: Pose
    """Pose of the corner of cell (0, 0) in the header's frame."""


class OccupancyGrid(Stamped, Serializable):
    """The occupancy probability of each cell of a map."""

    info: MapMetadata
    """Position and resolution of the map."""
    data: list[Int8]
    """Occupancy in row-major order from (0, 0): 0 to 100 percent, -1 if unknown."""


class GridCells(Stamped, Serializable):
    """A set of grid cells."""

    cell_width: Float32
    """m."""
    cell_height: Float32
    """m."""
    cells: list[Point3d]
    """Centers of the cells, m."""
