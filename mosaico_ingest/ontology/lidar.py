"""This file is spatial laser scanners."""

from __future__ import annotations

from mosaico_ingest.ontology.cloud import Cloud
from mosaico_ingest.ontology.fields import Float32, Float64, UInt8, UInt16
from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["Lidar"]


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
