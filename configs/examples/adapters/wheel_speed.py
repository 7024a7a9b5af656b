"""An adapter in Python: the speeds of a robot's two wheels, from its joint states."""

from __future__ import annotations

from typing import Any

from mosaico_ingest import ROSAdapterBase, Serializable


class WheelSpeed(Serializable):
    """The speeds of two wheels, in rad/s."""

    left: float
    right: float


class WheelSpeedAdapter(ROSAdapterBase[WheelSpeed]):
    """Convert joint states that contain the joints `left_wheel` and `right_wheel`."""

    ros_msgtype = "sensor_msgs/msg/JointState"
    __mosaico_ontology_type__ = WheelSpeed

    @classmethod
    def from_dict(cls, ros_data: dict[str, Any]) -> WheelSpeed:
        """Return the speeds of one message; a message without the joints raises and is rejected."""
        speeds = dict(zip(ros_data["name"], ros_data["velocity"], strict=True))
        return WheelSpeed(left=speeds["left_wheel"], right=speeds["right_wheel"])
