"""Points, vectors, rotations, poses, transforms, motion, forces and their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from pydantic import BaseModel, model_validator
from typing_extensions import Self

from mosaico_ingest.ontology.model import FixedSize, Float64, Int16, Nullable, Serializable, Stamped


class Uncertain(Stamped):
    """A value of several components, with a header and a covariance."""

    covariance: list[Float64] | None = None
    """The covariance matrix in row-major order, in the square of the components' units; null if unknown."""
    covariance_type: Int16 | None = None
    """The kind of covariance, as a code of the sender."""


class Varying(BaseModel):
    """A value of one component; its columns precede the header."""

    variance: Float64 | None = None
    """The variance in the square of the value's unit; null if unknown."""
    variance_type: Int16 | None = None
    """The kind of variance, as a code of the sender."""


_Component = Annotated[Float64, Nullable]


class _Components(BaseModel):
    """Named components in a fixed order."""

    @classmethod
    def from_list(cls, values: Sequence[float]) -> Self:
        """Return the components from a list.

        Raises:
            ValueError: The number of values is wrong.
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
    """The fourth component; the scalar part of a rotation."""


class Vector2d(_Planar, Uncertain, Serializable):
    """A direction and length in a plane."""


class Vector3d(_Spatial, Uncertain, Serializable):
    """A direction and length in space, in the unit of the field that contains it."""


class Vector4d(_Quadruple, Uncertain, Serializable):
    """Four components."""


class Point2d(_Planar, Uncertain, Serializable):
    """A position in a plane, in m unless the field states another unit."""


class Point3d(_Spatial, Uncertain, Serializable):
    """A position in space, in m unless the field states another unit."""


class Quaternion(_Quadruple, Uncertain, Serializable):
    """A rotation as a unit quaternion: `x`, `y`, `z` are the vector part, `w` is the scalar part."""


class Pose(Uncertain, Serializable):
    """The position and orientation of a body in the header's frame; the covariance is 6 x 6, position first."""

    position: Point3d
    """m."""
    orientation: Quaternion
    """Rotation from the body's frame to the header's."""


class Transform(Uncertain, Serializable):
    """The transformation between two frames; the header's frame is the parent."""

    translation: Vector3d
    """Origin of the target frame in the parent frame, m."""
    rotation: Quaternion
    """Rotation from the target frame to the parent frame."""
    target_frame_id: str | None = None
    """The target frame."""


class Polygon(Stamped, Serializable):
    """A closed polygon; the last point connects to the first."""

    points: list[Point3d]
    """Corners in order, m."""


class RobotPath(Stamped, Serializable):
    """A path as a sequence of poses."""

    poses: list[Pose]
    """The poses, each with its own header."""


class _LinearOrAngular(BaseModel):
    linear: Vector3d | None = None
    """Linear part: m/s of a velocity, m/s² of an acceleration."""
    angular: Vector3d | None = None
    """Angular part: rad/s of a velocity, rad/s² of an acceleration."""

    @model_validator(mode="after")
    def _has_one(self) -> Self:
        if self.linear is None and self.angular is None:
            raise ValueError("linear or angular is required")
        return self


class Velocity(_LinearOrAngular, Uncertain, Serializable):
    """Linear and angular velocity of a body; the covariance is 6 x 6, linear first."""


class Acceleration(_LinearOrAngular, Uncertain, Serializable):
    """Linear and angular acceleration of a body; the covariance is 6 x 6, linear first."""


class MotionState(Uncertain, Serializable):
    """The pose and the motion of a body."""

    pose: Pose
    """In the header's frame."""
    velocity: Velocity
    """In the target frame."""
    target_frame_id: str
    """The body's frame."""
    acceleration: Acceleration | None = None
    """In the target frame."""


class ForceTorque(Uncertain, Serializable):
    """Force and torque on a body in the header's frame."""

    force: Vector3d
    """N."""
    torque: Vector3d
    """N·m."""


class Inertia(Stamped, Serializable):
    """The mass distribution of a body."""

    mass: Float64
    """kg."""
    center_of_mass: Vector3d
    """m."""
    inertia: Annotated[list[Float64], FixedSize(6)]
    """The symmetric inertia tensor as xx, xy, xz, yy, yz, zz, in kg·m²."""


class FrameTransform(Serializable):
    """Edges of the transform tree."""

    transforms: list[Transform]
    """The transforms, each with its own header."""
