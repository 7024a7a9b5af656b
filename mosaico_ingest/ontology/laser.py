"""This file is planar laser scanners."""

from __future__ import annotations

from mosaico_ingest.ontology.fields import Float32
from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["LaserScan", "MultiEchoLaserScan"]


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
