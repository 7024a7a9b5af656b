"""This file is motion: velocity, acceleration and the state of a moving body."""

from __future__ import annotations

from pydantic import BaseModel, model_validator
from typing_extensions import Self

from mosaico_ingest.ontology.geometry import Pose, Vector3d
from mosaico_ingest.ontology.serializable import Serializable
from mosaico_ingest.ontology.uncertainty import Uncertain

__all__ = ["Acceleration", "MotionState", "Velocity"]


class _LinearOrAngular(BaseModel):
    linear: Vector3d | None = None
    """Of the origin: m/s for a velocity, m/s² for an acceleration."""
    angular: Vector3d | None = None
    """About the axes: rad/s for a velocity, rad/s² for an acceleration."""

    @model_validator(mode="after")
    def _has_one(self) -> Self:
        if self.linear is None and self.angular is None:
            raise ValueError("linear or angular must be given")
        return self


class Velocity(_LinearOrAngular, Uncertain, Serializable):
    """How fast a body moves and turns; the covariance is 6 by 6, linear first."""


class Acceleration(_LinearOrAngular, Uncertain, Serializable):
    """How fast a velocity changes; the covariance is 6 by 6, linear first."""


class MotionState(Uncertain, Serializable):
    """Where a body is and how it moves."""

    pose: Pose
    """In the header's frame."""
    velocity: Velocity
    """In the target frame."""
    target_frame_id: str
    """The body's own frame."""
    acceleration: Acceleration | None = None
    """In the target frame."""
