"""This file is one message as a dictionary: what the loader yields and an adapter written in Python gets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mosaico_ingest.frozen import frozen

__all__ = ["ROSHeader", "ROSMessage"]


@frozen
class ROSHeader:
    """The `std_msgs/Header` of a message."""

    stamp_ns: int
    """`stamp` in nanoseconds."""
    frame_id: str
    seq: int | None = None
    """Only ROS 1 has one."""


@dataclass(frozen=True)
class ROSMessage:
    """One message: when it was recorded, where, of which type, and its fields by name."""

    bag_timestamp_ns: int
    """When it was recorded, ns since the epoch."""
    topic: str
    msg_type: str
    """`pkg/msg/Name`."""
    data: dict[str, Any]
    """Nested messages are dictionaries, arrays are lists, `uint8[]` and its like `bytes`."""

    @property
    def timestamp_ns(self) -> int:
        """The same as `bag_timestamp_ns`."""
        return self.bag_timestamp_ns

    @property
    def header(self) -> ROSHeader | None:
        """The message's header; None where it has none, or a field of that name which is something else."""
        match self.data.get("header"):
            case {"stamp": {"sec": int(sec), "nanosec": int(nanosec)}, "frame_id": str(frame_id)} as header:
                seq = header.get("seq")
                return ROSHeader(
                    sec * 1_000_000_000 + nanosec, frame_id, seq if isinstance(seq, int) else None
                )
            case _:
                return None
