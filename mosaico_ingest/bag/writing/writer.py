"""This file is the seam of containers that are written."""

from __future__ import annotations

from typing import Protocol

from mosaico_ingest.bag.definition import Definition

__all__ = ["RecordingWriter"]


class RecordingWriter(Protocol):
    """Takes messages by log time; those of ROS 1 definitions in ROS 1's encoding, others as little-endian CDR."""

    def channel(self, topic: str, definition: Definition) -> int:
        """Open a channel and return its number.

        Raises:
            BagError: The container cannot hold it.
        """
        ...

    def write(self, channel: int, log_ns: int, payload: bytes) -> None:
        """Append a message."""
        ...

    def finish(self) -> None:
        """Write what comes last."""
        ...

    def abandon(self) -> None:
        """Close the file, which stays unfinished."""
        ...
