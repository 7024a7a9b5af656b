"""The values of a job's options: policies, distros, time bounds, limits and targets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, ClassVar, TypeAlias

from msgspec import Struct

from mosaico_ingest.remote import AnyPath

DEFAULT_STORE = Path("mosaico")
DEFAULT_PORT = 6726
DEFAULT_MESSAGE_BYTES = 10_000_000
"""Default size of an upload message. Larger messages gain no throughput and may become chunks that clients cannot read."""
DEFAULT_TOPIC = "default"
"""The key of `on_error.topic` for topics that no other key matches."""
PROVENANCE_KEY = "mosaico_ingest"
"""The metadata key of a sequence, and of each of its sessions, for its provenance."""
ATTACHMENTS_KEY = "_attachments_"
"""The metadata key of a session in a store that lists the attachments that the session stored."""


RECORDING = "recording"
"""The word for the whole recording where a contract may also name a topic."""


LOCK_SUFFIX = ".lock.json"
"""Suffix of a lock file, in place of that of its manifest."""


class LockFile(Struct, frozen=True):
    """The lock file of a manifest: its path, and the text that was read when the job was compiled."""

    path: str
    text: str


class SessionLevelErrorPolicy(str, Enum):
    """The action after an error that ends the run."""

    Report = "report"
    """Keep the accepted rows, attach the error to the sequence, and close the session."""
    Delete = "delete"
    """Delete the session."""


class TopicLevelErrorPolicy(str, Enum):
    """The action after an error in a topic."""

    Raise = "raise"
    """End the run; the session policy applies."""
    Ignore = "ignore"
    """Reject the message and continue the topic."""
    Finalize = "finalize"
    """Close the topic with its accepted rows and continue the other topics."""


class LoaderErrorPolicy(str, Enum):
    """The action for a message that cannot be decoded."""

    IGNORE = "ignore"
    """Count the message."""
    LOG_WARN = "log_warn"
    """Count the message and log a warning."""
    RAISE = "raise"
    """End the run."""


class IfExists(str, Enum):
    """The action if the sequence exists."""

    FAIL = "fail"
    SKIP = "skip"
    APPEND = "append"
    REPLACE = "replace"


class OnSchemaChange(str, Enum):
    """The action if a topic's definition differs from that of earlier sequences of the family."""

    FAIL = "fail"
    EVOLVE = "evolve"
    """Warn and store the topic with its new columns."""
    NEW_TOPIC = "new_topic"
    """Store the topic under another name."""


class OnFailure(str, Enum):
    """The action if an expectation of a contract fails."""

    FAIL = "fail"
    """Commit nothing."""
    WARN = "warn"
    """Commit, and report the failure."""
    DIVERT = "divert"
    """Commit under the name `<name>__failed`."""


class StampSource(str, Enum):
    """The time of a message that becomes `timestamp_ns` of its row."""

    LOG = "log"
    """The time at which the recorder received the message."""
    PUBLISH = "publish"
    """The time at which the publisher sent the message, which only MCAP files contain; in other files the log time."""
    HEADER = "header"
    """The stamp of the message's header; the log time if the type has no header or the stamp is zero."""


class Unmodeled(str, Enum):
    """The action for a topic whose type has no adapter."""

    KEEP = "keep"
    """Store the topic in its ROS shape."""
    SKIP = "skip"
    FAIL = "fail"


class Stores(str, Enum):
    """The distros with known standard message definitions; the values are those of rosbags."""

    EMPTY = "empty"
    LATEST = "latest"
    ROS1_NOETIC = "ros1_noetic"
    ROS2_DASHING = "ros2_dashing"
    ROS2_ELOQUENT = "ros2_eloquent"
    ROS2_FOXY = "ros2_foxy"
    ROS2_GALACTIC = "ros2_galactic"
    ROS2_HUMBLE = "ros2_humble"
    ROS2_IRON = "ros2_iron"
    ROS2_JAZZY = "ros2_jazzy"
    ROS2_KILTED = "ros2_kilted"
    ROS2_LYRICAL = "ros2_lyrical"


class TimeBound(Struct, frozen=True):
    """An instant in ns since the epoch, or an offset in ns from the first message (from the last message if negative)."""

    ns: int
    relative: bool = False

    def at(self, start_ns: int, end_ns: int) -> int:
        """Return the bound in ns since the epoch, for a recording with this first and last log time."""
        if not self.relative:
            return self.ns
        return (end_ns if self.ns < 0 else start_ns) + self.ns


class Limit(Struct, frozen=True):
    """A maximum number of messages, or their maximum share from 0 to 1; the other attribute is None."""

    count: int | None = None
    share: float | None = None

    def measure(self, count: int, total: int) -> float:
        """Return what the limit applies to: the number, or its share of a total (0 if the total is 0)."""
        return count if self.count is not None else (count / total if total else 0.0)

    def allows(self, count: int, total: int) -> bool:
        """Return whether a number, as part of a total, is within the limit."""
        return count <= (self.count if self.count is not None else (self.share or 0) * total)


class Interval(Struct, frozen=True):
    """A length of time: nanoseconds, or a multiple of a topic's period; the other attribute is None."""

    ns: int | None = None
    periods: float | None = None

    def __str__(self) -> str:
        """Return the length in the notation of manifests."""
        return f"{self.periods:g} periods" if self.ns is None else f"{self.ns} ns"


class Compression(str, Enum):
    """The trade-off between the size of a stored sequence and the time to compress it."""

    FAST = "fast"
    """Encodings by type and the lowest level of zstd."""
    SMALL = "small"
    """For each column the smallest encoding of a sample, and a higher level of zstd."""


class StoreTarget(Struct, frozen=True):
    """The embedded store in a directory, or behind a URL."""

    kind: ClassVar[str] = "store"
    path: AnyPath
    compression: Compression = Compression.FAST


@dataclass(frozen=True, slots=True)
class ServerTarget:
    """A Mosaico server."""

    kind: ClassVar[str] = "server"
    host: str
    port: int
    api_key: str | None = field(default=None, repr=False)
    tls_cert: Path | None = None
    tls: bool = False
    message_bytes: int = DEFAULT_MESSAGE_BYTES
    """Maximum size, in bytes, up to which rows are combined into one upload message."""


class PluginTarget(Struct, frozen=True):
    """A destination that an installed package provides; see `mosaico_ingest.destinations.base`."""

    kind: str
    """The name of its entry point."""
    options: Mapping[str, Any] = {}
    base_dir: Path = Path()
    """The folder where the relative paths of `options` start."""


Target: TypeAlias = StoreTarget | ServerTarget | PluginTarget
