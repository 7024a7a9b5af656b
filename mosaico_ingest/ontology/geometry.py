"""Points, vectors, rotations, poses, transforms, motion, forces and their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from pydantic import BaseModel, model_validator
from typing_extensions import Self

from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.model import FixedSize, Float64, Int16, Nullable, Serializable

__all__ = [
    "Acceleration",
    "ForceTorque",
    "FrameTransform",
    "Inertia",
    "MotionState",
    "Point2d",
    "Point3d",
    "Polygon",
    "Pose",
    "Quaternion",
    "RobotPath",
    "Transform",
    "Uncertain",
    "Varying",
    "Vector2d",
    "Vector3d",
    "Vector4d",
    "Velocity",
]


class Uncertain(Stamped):
    """A stamped value of several components."""

    covariance: list[Float64] | None = None
    """The covariance matrix row by row, in the square of the components' units; null where it is not known."""
    covariance_type: Int16 | None = None
    """How the covariance came about, in the sender's code."""


class Varying(BaseModel):
    """A value of one component; these columns come before its header."""

    variance: Float64 | None = None
    """In the square of the value's unit; null where it is not known."""
    variance_type: Int16 | None = None
    """How the variance came about, in the sender's code."""


_Component = Annotated[Float64, Nullable]


class _Components(BaseModel):
    """Values along axes, in an order."""

    @classmethod
    def from_list(cls, values: Sequence[float]) -> Self:
        """Return the components given one after the other.

        Raises:
            ValueError: There are too few or too many.
        """
        axes = [name for name in cls.model_fields if name in "xyzw"]
        return cls(**dict(zip(axes, values, strict=True)))


class _Planar(_Components):
    x: _Component
    """Along the first axis."""
    y: _Component
    """Along the second axis."""


class _Spatial(_Planar):
    z: _Component
    """Along the third axis."""


class _Quadruple(_Spatial):
    w: _Component
    """The fourth component; of a rotation the scalar part."""


class Vector2d(_Planar, Uncertain, Serializable):
    """A direction and length in a plane."""


class Vector3d(_Spatial, Uncertain, Serializable):
    """A direction and length in space; the unit is that of the field it stands in."""


class Vector4d(_Quadruple, Uncertain, Serializable):
    """Four components that belong together."""


class Point2d(_Planar, Uncertain, Serializable):
    """A position in a plane, m unless the field says otherwise."""


class Point3d(_Spatial, Uncertain, Serializable):
    """A position in space, m unless the field says otherwise."""


class Quaternion(_Quadruple, Uncertain, Serializable):
    """A rotation: `x`, `y`, `z` the vector part, `w` the scalar part; length 1."""


class Pose(Uncertain, Serializable):
    """Where a body is and how it is turned, in the header's frame; the covariance is 6 by 6, position first."""

    position: Point3d
    """m."""
    orientation: Quaternion
    """From the body's frame into the header's."""


class Transform(Uncertain, Serializable):
    """The way from one frame to another: the header's frame is the parent."""

    translation: Vector3d
    """Origin of the target frame in the parent's, m."""
    rotation: Quaternion
    """From the target frame into the parent's."""
    target_frame_id: str | None = None
    """The frame that is placed."""


class Polygon(Stamped, Serializable):
    """A closed line; the last point joins the first."""

    points: list[Point3d]
    """Corners in order, m."""


class RobotPath(Stamped, Serializable):
    """Poses to go through, in order."""

    poses: list[Pose]
    """Each with its own header."""


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


class FrameTransform(Serializable):
    """Edges of the tree of frames."""

    transforms: list[Transform]
    """Each with its own header."""
