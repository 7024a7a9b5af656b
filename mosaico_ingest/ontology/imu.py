"""This file is inertial measurement."""

from __future__ import annotations

from mosaico_ingest.ontology.geometry import Quaternion, Vector3d
from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["IMU"]


class IMU(Stamped, Serializable):
    """Acceleration and rate of turn of a body, each with its own covariance, 3 by 3."""

    acceleration: Vector3d
    """m/s², gravity included."""
    angular_velocity: Vector3d
    """rad/s."""
    orientation: Quaternion | None = None
    """null where the sensor does not estimate it."""
