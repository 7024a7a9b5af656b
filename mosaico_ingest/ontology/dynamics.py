"""This file is forces and masses."""

from __future__ import annotations

from typing import Annotated

from mosaico_ingest.ontology.fields import FixedSize, Float64
from mosaico_ingest.ontology.geometry import Vector3d
from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.serializable import Serializable
from mosaico_ingest.ontology.uncertainty import Uncertain

__all__ = ["ForceTorque", "Inertia"]


class ForceTorque(Uncertain, Serializable):
    """What acts on a body at the header's frame."""

    force: Vector3d
    """N."""
    torque: Vector3d
    """N·m."""


class Inertia(Stamped, Serializable):
    """How a body resists being moved and turned."""

    mass: Float64
    """kg."""
    center_of_mass: Vector3d
    """m."""
    inertia: Annotated[list[Float64], FixedSize(6)]
    """The symmetric tensor as xx, xy, xz, yy, yz, zz; kg·m²."""
