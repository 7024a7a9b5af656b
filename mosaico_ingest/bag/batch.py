"""This file is what a recording yields: channels, and messages of one channel in batches."""

from __future__ import annotations

from dataclasses import field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from mosaico_ingest.bag.definition import Definition
from mosaico_ingest.frozen import frozen

__all__ = ["Channel", "Encoding", "Loss", "RawBatch"]


class Encoding(str, Enum):
    """How a payload is serialised."""

    CDR = "cdr"
    """ROS 2: a 4-byte encapsulation header, then aligned little- or big-endian fields."""
    ROS1 = "ros1"
    """ROS 1: packed little-endian fields."""
    OTHER = "other"
    """Not a ROS encoding (protobuf, json, …): named, never decoded."""


@frozen
class Channel:
    """Messages of one type on one topic, written the same way; a topic may have several."""

    id: int
    """Unique within the recording, whatever its parts."""
    topic: str
    msgtype: str
    """`pkg/msg/Name`, also for ROS 1 and for old names."""
    encoding: Encoding
    count: int | None
    """How many messages the index promises; None where there is no index."""
    definition: Definition | None
    """None where no definition could be found; `problem` then says why."""
    problem: str | None = None
    latched: bool = False
    attributes: dict[str, str] = field(default_factory=dict[str, str])
    """What else the recording says: QoS profiles, caller id, md5, raw encoding name."""


@frozen
class RawBatch:
    """n messages of one channel in log-time order, their payloads inside one buffer."""

    channel: Channel
    log_times: NDArray[np.int64]
    """When each was recorded, ns since the epoch, shape (n,)."""
    data: NDArray[np.uint8]
    """The buffer; may hold more than the payloads."""
    starts: NDArray[np.int64]
    """Where each payload begins in `data`, shape (n,)."""
    lengths: NDArray[np.int64]
    """How many bytes each payload has, shape (n,)."""
    offsets: NDArray[np.int64]
    """Where each lies in the source, for messages about it: file offset of its record or chunk, or row id; shape (n,)."""

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.log_times)

    def rows(self, choice: NDArray[np.int64] | slice) -> RawBatch:
        """Return some of the messages, over the same buffer."""
        return RawBatch(
            self.channel,
            self.log_times[choice],
            self.data,
            self.starts[choice],
            self.lengths[choice],
            self.offsets[choice],
        )

    def payload(self, row: int) -> bytes:
        """Return the bytes of one message."""
        start = int(self.starts[row])
        return self.data[start : start + int(self.lengths[row])].tobytes()


@frozen
class Loss:
    """Something of a recording that could not be read, and why."""

    file: str
    offset: int
    """Where in the file the record or chunk begins, or the row id."""
    reason: str
    """What was expected and what was found, in one line."""
    channel: int | None = None
    """The channel the messages belonged to; None where that is unknown."""
    count: int | None = None
    """How many messages were lost; None where that is unknown, 0 where all could be had another way."""
