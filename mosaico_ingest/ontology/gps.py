"""This file is satellite positioning."""

from __future__ import annotations

from mosaico_ingest.ontology.fields import Float64, Int8, UInt16
from mosaico_ingest.ontology.geometry import Point3d, Vector3d
from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["GPS", "GPSStatus", "NMEASentence"]


class GPSStatus(Serializable):
    """How good a fix is."""

    status: Int8
    """-1 no fix, 0 fix, 1 satellite-based, 2 ground-based augmentation."""
    service: UInt16
    """The systems used, one bit each: 1 GPS, 2 GLONASS, 4 COMPASS, 8 Galileo."""
    satellites: Int8 | None = None
    """Satellites in use."""
    hdop: Float64 | None = None
    """Horizontal dilution of precision."""
    vdop: Float64 | None = None
    """Vertical dilution of precision."""


class GPS(Stamped, Serializable):
    """A fix on the WGS 84 ellipsoid."""

    position: Point3d
    """x latitude and y longitude in degrees, z altitude in m; its covariance is 3 by 3, east north up, m²."""
    velocity: Vector3d | None = None
    """m/s."""
    status: GPSStatus | None = None
    """null where the receiver does not say."""


class NMEASentence(Stamped, Serializable):
    """A line of a receiver."""

    sentence: str
    """From `$` on, without the line's end."""
