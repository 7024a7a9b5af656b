"""This file is the joints of a robot."""

from __future__ import annotations

from mosaico_ingest.ontology.fields import Float64
from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["RobotJoint"]


class RobotJoint(Stamped, Serializable):
    """The state of joints: one entry a joint in every list, or an empty list where it is not known."""

    names: list[str]
    """The joints' names."""
    positions: list[Float64]
    """rad of a revolute joint, m of a prismatic one."""
    velocities: list[Float64]
    """rad/s or m/s."""
    efforts: list[Float64]
    """N·m or N."""
