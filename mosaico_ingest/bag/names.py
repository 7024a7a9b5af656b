"""This file spells message type names one way, `pkg/msg/Name`, and knows what old names became."""

from __future__ import annotations

__all__ = ["DURATION", "HEADER", "TIME", "normalize_msgtype", "short_msgtype"]

TIME = "builtin_interfaces/msg/Time"
DURATION = "builtin_interfaces/msg/Duration"
HEADER = "std_msgs/msg/Header"

_KINDS = frozenset({"msg", "srv", "action"})
_RENAMED = {
    "roslib/msg/Header": HEADER,
    "roslib/msg/Log": "rosgraph_msgs/msg/Log",
    "roslib/msg/Clock": "rosgraph_msgs/msg/Clock",
}


def normalize_msgtype(name: str) -> str:
    """Return `pkg/msg/Name` for `pkg/Name`, for DDS's `pkg::msg::dds_::Name_`, and for names ROS has given up.

    Service and action parts keep their kind (`pkg/srv/Name_Request`), a name without a package stays as it is.
    """
    parts = [part for part in name.strip().replace("::", "/").split("/") if part]
    if "dds_" in parts:
        parts = [part for part in parts if part != "dds_"]
        parts[-1] = parts[-1].removesuffix("_")
    if len(parts) > 1 and parts[-2] not in _KINDS:
        parts.insert(-1, "msg")
    full = "/".join(parts)
    return _RENAMED.get(full, full)


def short_msgtype(name: str) -> str:
    """Return the name as definition texts spell it: `pkg/Name` for `pkg/msg/Name`, any other unchanged."""
    return name.replace("/msg/", "/", 1)
