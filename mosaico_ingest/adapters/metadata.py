"""This file is what every topic says about its ROS origin, under one reserved metadata key."""

from __future__ import annotations

import math
from typing import Any

from mosaico_ingest.bag.definition import Definition

__all__ = ["ROS_METADATA_KEY", "ros_metadata"]

ROS_METADATA_KEY = "_ros_"
"""Reserved: it wins over a key of the same name in the user's own topic metadata."""


def ros_metadata(definition: Definition, source_file: str) -> dict[str, Any]:
    """Return `{"_ros_": {msgtype, enums, msgdef, source_file}}`; enums are the constants of the type itself.

    A constant that is not a finite number is spelled `NaN`, `Infinity` or `-Infinity`: JSON has no number for it.
    """
    return {
        ROS_METADATA_KEY: {
            "msgtype": definition.root,
            "enums": {
                constant.name: _json_value(constant.value) for constant in definition.message.constants
            },
            "msgdef": definition.text,
            "source_file": source_file,
        }
    }


def _json_value(value: object) -> object:
    if not isinstance(value, float) or math.isfinite(value):
        return value
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
