"""Units of the columns of the built-in ontology types, as text for people."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

_POSE = {"position": "m"}
_VELOCITY = {"linear": "m/s", "angular": "rad/s"}
_ACCELERATION = {"linear": "m/s²", "angular": "rad/s²"}
_CLOUD = {"x": "m", "y": "m", "z": "m"}
_BEAMS = {"range": "m", "azimuth": "rad", "elevation": "rad"}
_SWEEP = {
    **dict.fromkeys(("angle_min", "angle_max", "angle_increment"), "rad"),
    **dict.fromkeys(("time_increment", "scan_time"), "s"),
    **dict.fromkeys(("range_min", "range_max", "ranges"), "m"),
}
_MAP = {"resolution": "m", "width": "cells", "height": "cells", "origin.position": "m"}
_REGION = {"offset": "px", "height": "px", "width": "px"}


def _below(prefix: str, units: Mapping[str, str]) -> dict[str, str]:
    return {f"{prefix}.{path}": unit for path, unit in units.items()}


UNITS: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        "Acceleration": _ACCELERATION,
        "BatteryState": {
            "voltage": "V",
            "temperature": "°C",
            "current": "A",
            "charge": "Ah",
            "capacity": "Ah",
            "design_capacity": "Ah",
            "cell_voltage": "V",
            "cell_temperature": "°C",
        },
        "CameraInfo": {
            "height": "px",
            "width": "px",
            "intrinsic_parameters": "px",
            "projection_parameters": "px",
            **_below("roi", _REGION),
        },
        "ForceTorque": {"force": "N", "torque": "N·m"},
        "FrameTransform": {"transforms.translation": "m"},
        "GPS": {"position.x": "°", "position.y": "°", "position.z": "m", "velocity": "m/s"},
        "GridCells": {"cell_width": "m", "cell_height": "m", "cells": "m"},
        "IMU": {"acceleration": "m/s²", "angular_velocity": "rad/s"},
        "Image": {"width": "px", "height": "px", "stride": "B"},
        "Inertia": {"mass": "kg", "center_of_mass": "m", "inertia": "kg·m²"},
        "LaserScan": _SWEEP,
        "Lidar": {**_CLOUD, **_BEAMS},
        "Magnetometer": {"magnetic_field": "T"},
        "MapMetadata": _MAP,
        "MotionState": {
            **_below("pose", _POSE),
            **_below("velocity", _VELOCITY),
            **_below("acceleration", _ACCELERATION),
        },
        "MultiEchoLaserScan": _SWEEP,
        "OccupancyGrid": {**_below("info", _MAP), "data": "%"},
        "PointCloud2": {"point_step": "B", "row_step": "B"},
        "Polygon": {"points": "m"},
        "Pose": _POSE,
        "Pressure": {"value": "Pa"},
        "RGBDCamera": _CLOUD,
        "ROI": _REGION,
        "Radar": {
            **_CLOUD,
            **_BEAMS,
            "rcs": "dBm²",
            "snr": "dB",
            **dict.fromkeys(("doppler_velocity", "vx", "vy", "vx_comp", "vy_comp", "radial_speed"), "m/s"),
            **dict.fromkeys(("ax", "ay"), "m/s²"),
        },
        "Range": {"field_of_view": "rad", **dict.fromkeys(("min_range", "max_range", "range"), "m")},
        "RobotPath": _below("poses", _POSE),
        "StereoCamera": _CLOUD,
        "Temperature": {"value": "K"},
        "ToFCamera": _CLOUD,
        "Transform": {"translation": "m"},
        "Velocity": _VELOCITY,
    }
)
"""Units by ontology tag and column; the unit of a struct applies to its components."""

_WITHOUT_UNIT = frozenset({"header", "covariance", "covariance_type", "variance", "variance_type"})
"""Members of a struct that do not have the unit of its components."""


def column_unit(tag: str, path: str) -> str:
    """Return the unit of a column such as `acceleration.x`, or an empty text if it has none or none is known."""
    units = UNITS.get(tag, {})
    steps = path.split(".")
    for length in range(len(steps), 0, -1):
        unit = units.get(".".join(steps[:length]))
        if unit is not None:
            return "" if _WITHOUT_UNIT.intersection(steps[length:]) else unit
    return ""
