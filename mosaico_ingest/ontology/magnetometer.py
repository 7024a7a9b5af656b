"""This file is magnetic fields."""

from __future__ import annotations

from mosaico_ingest.ontology.geometry import Vector3d
from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["Magnetometer"]


class Magnetometer(Stamped, Serializable):
    """The field at the sensor."""

    magnetic_field: Vector3d
    """T; its covariance is 3 by 3, T²."""
