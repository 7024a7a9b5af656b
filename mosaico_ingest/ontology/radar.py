"""This file is radar."""

from __future__ import annotations

from mosaico_ingest.ontology.cloud import Cloud
from mosaico_ingest.ontology.fields import Float32
from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["Radar"]


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
