"""This file is points, vectors, rotations and what is built of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from pydantic import BaseModel
from typing_extensions import Self

from mosaico_ingest.ontology.fields import Float64, Nullable
from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.serializable import Serializable
from mosaico_ingest.ontology.uncertainty import Uncertain

__all__ = [
    "Point2d",
    "Point3d",
    "Polygon",
    "Pose",
    "Quaternion",
    "RobotPath",
    "Transform",
    "Vector2d",
    "Vector3d",
    "Vector4d",
]

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
