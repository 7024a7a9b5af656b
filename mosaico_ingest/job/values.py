"""The types of a job: policies, time ranges, limits and destinations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, ClassVar, TypeAlias

from msgspec import Struct

from mosaico_ingest.remote import AnyPath

__all__ = [
    "DEFAULT_MESSAGE_BYTES",
    "DEFAULT_PORT",
    "DEFAULT_STORE",
    "DEFAULT_TOPIC",
    "PROVENANCE_KEY",
    "IfExists",
    "Limit",
    "LoaderErrorPolicy",
    "OnSchemaChange",
    "PluginTarget",
    "ServerTarget",
    "SessionLevelErrorPolicy",
    "StoreTarget",
    "Stores",
    "Target",
    "TimeBound",
    "TopicLevelErrorPolicy",
    "Unmodeled",
]


DEFAULT_STORE = Path("mosaico")
DEFAULT_PORT = 6726
DEFAULT_MESSAGE_BYTES = 10_000_000
"""Larger upload messages gain no throughput, and may become chunks that no client can read back."""
DEFAULT_TOPIC = "default"
"""The key of `topics_on_error` for every topic that no other key matches."""
PROVENANCE_KEY = "mosaico_ingest"
"""The key of a sequence's metadata, and of each of its sessions, that says what it was made from."""


class SessionLevelErrorPolicy(str, Enum):
    """What an error that ends the run leaves behind."""

    Report = "report"
    """Keep what was accepted, attach the error to the sequence, close the session."""
    Delete = "delete"
    """Leave no trace of the session."""


class TopicLevelErrorPolicy(str, Enum):
    """What an error in one topic does to the rest."""

    Raise = "raise"
    """End the run; the session policy decides what stays."""
    Ignore = "ignore"
    """Reject the message, note it, go on with the topic."""
    Finalize = "finalize"
    """Close the topic with the rows it has, go on with the others."""


class LoaderErrorPolicy(str, Enum):
    """What happens to a message whose bytes do not fit its type."""

    IGNORE = "ignore"
    """Count it."""
    LOG_WARN = "log_warn"
    """Count it and say so."""
    RAISE = "raise"
    """End the run."""


class IfExists(str, Enum):
    """What to do when the sequence's name is taken."""

    FAIL = "fail"
    SKIP = "skip"
    APPEND = "append"
    REPLACE = "replace"


class OnSchemaChange(str, Enum):
    """What to do when a topic's message definition is not what it was in its family of sequences."""

    FAIL = "fail"
    EVOLVE = "evolve"
    """Say so and store the topic with its new columns."""
    NEW_TOPIC = "new_topic"
    """Store it under a name of its own."""


class Unmodeled(str, Enum):
    """What to do with a topic whose type has no adapter."""

    KEEP = "keep"
    """Store it in its ROS shape."""
    SKIP = "skip"
    FAIL = "fail"


class Stores(str, Enum):
    """The distros whose standard message definitions are known; the values are those of rosbags."""

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
    """A moment: ns since the epoch, or ns from the recording's first message (negative: back from its last)."""

    ns: int
    relative: bool = False

    def at(self, start_ns: int, end_ns: int) -> int:
        """Return ns since the epoch, given the recording's first and last log time."""
        if not self.relative:
            return self.ns
        return (end_ns if self.ns < 0 else start_ns) + self.ns


class Limit(Struct, frozen=True):
    """At most so many messages, or at most this share of them, from 0 to 1; one of the two is None."""

    count: int | None = None
    share: float | None = None


class StoreTarget(Struct, frozen=True):
    """The embedded store in a directory, or behind a URL."""

    kind: ClassVar[str] = "store"
    path: AnyPath


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
    """The size up to which rows are combined into one upload message."""


class PluginTarget(Struct, frozen=True):
    """A destination that an installed package provides; see `mosaico_ingest.destinations.registry`."""

    kind: str
    """The name of its entry point."""
    options: Mapping[str, Any] = {}
    base_dir: Path = Path()
    """The folder that relative paths of `options` start from."""


Target: TypeAlias = StoreTarget | ServerTarget | PluginTarget
