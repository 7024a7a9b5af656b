"""This file is the functions of rotations; angles in rad, quaternions as `{x, y, z, w}`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mosaico_ingest.adapters.mapping.arrow import Array, DataType, arrays, pc
from mosaico_ingest.adapters.mapping.columns import field_of
from mosaico_ingest.adapters.mapping.functions.registry import FLOAT, function, struct_with
from mosaico_ingest.adapters.mapping.kinds import is_number

__all__ = ["QUATERNION_TYPE"]

_AXES = ("x", "y", "z", "w")
QUATERNION_TYPE: DataType = arrays.struct([(axis, arrays.float64()) for axis in _AXES])
_QUATERNION = struct_with("a quaternion {x, y, z, w}", dict.fromkeys(_AXES, is_number))


def _halves(*angles: Array) -> tuple[NDArray[np.bool_], list[NDArray[np.float64]]]:
    """Return half the angles, broadcast, with NaN for null; and where one of them is null."""
    plain = [np.asarray(pc.fill_null(angle, np.nan), np.float64) for angle in angles]
    absent = np.zeros(np.broadcast_shapes(*(p.shape for p in plain)), bool)
    for angle in angles:
        absent |= np.asarray(pc.is_null(angle), bool)
    return absent, [np.broadcast_to(p, absent.shape) / 2 for p in plain]


def _sin_cos(half: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    with np.errstate(invalid="ignore"):  # of an infinite angle both are NaN
        return np.sin(half), np.cos(half)


def _quaternions(parts: tuple[NDArray[np.float64], ...], absent: NDArray[np.bool_]) -> Array:
    children = [arrays.array(np.ascontiguousarray(part)) for part in parts]
    mask = arrays.array(absent) if absent.any() else None
    return arrays.StructArray.from_arrays(children, fields=list(QUATERNION_TYPE), mask=mask)


@function(FLOAT, FLOAT, FLOAT, gives=QUATERNION_TYPE)
def quaternion_from_rpy(roll: Array, pitch: Array, yaw: Array) -> Array:
    """Rotation about the fixed axes x, then y, then z."""
    absent, (r, p, y) = _halves(roll, pitch, yaw)
    (sr, cr), (sp, cp), (sy, cy) = (_sin_cos(half) for half in (r, p, y))
    return _quaternions(
        (
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ),
        absent,
    )


@function(FLOAT, gives=QUATERNION_TYPE)
def quaternion_from_yaw(yaw: Array) -> Array:
    """Rotation in the plane, about z."""
    absent, (y,) = _halves(yaw)
    zero = np.zeros(len(y))
    return _quaternions((zero, zero, *_sin_cos(y)), absent)


@function(_QUATERNION, gives=arrays.float64())
def yaw(q: Array) -> Array:
    """Heading of a quaternion: its angle about z."""
    x, y, z, w = (pc.cast(field_of(q, axis), arrays.float64()) for axis in _AXES)
    sine = pc.multiply(pc.add(pc.multiply(w, z), pc.multiply(x, y)), 2.0)
    cosine = pc.subtract(1.0, pc.multiply(pc.add(pc.multiply(y, y), pc.multiply(z, z)), 2.0))
    return pc.atan2(sine, cosine)
