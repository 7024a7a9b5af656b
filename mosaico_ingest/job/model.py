"""The types of a job: policies, time ranges, limits and destinations."""

from __future__ import annotations

from enum import Enum

__all__ = [
    "IfExists",
    "LoaderErrorPolicy",
    "OnSchemaChange",
    "SessionLevelErrorPolicy",
    "Stores",
    "TopicLevelErrorPolicy",
    "Unmodeled",
]


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
