"""The table of container formats, used by detection, discovery, manifests, lint, the writers and the command line.

To add a container format, write a reader that satisfies `rosbag.blocks.SplitReader` and add a row to `CONTAINERS`. The
table names readers as text, so that importing it is cheap, also for packages below `rosbag`.
"""

from __future__ import annotations

import re

from msgspec import Struct


class Container(Struct, frozen=True):
    """A container format."""

    name: str
    """The name that reports and inspections show."""
    suffix: str
    magic: bytes
    """The first bytes of every file of this format."""
    ros_versions: tuple[int, ...]
    """The versions of ROS whose messages the container can store."""
    reader: str
    """The class of the reader, as `module:Class`."""
    by_offset: bool = True
    """Whether the reader reads by offset.

    If it does, it is called with a `Source` and the maximum decompressed size of a chunk in bytes; otherwise, with the
    path of a local file and the path to show in messages, or with the `CachedSource` of a file behind a URL."""


MCAP = b"\x89MCAP0\r\n"
ROSRECORD = b"#ROSRECORD V1.2"
ZSTD = b"\x28\xb5\x2f\xfd"
ACTIVE_SUFFIX = ".active"
"""Suffix of files that a recorder is writing, or was writing when it crashed."""
ZSTD_SUFFIX = ".zstd"
"""Suffix of files that rosbag2 compressed as a whole; every container may be compressed."""

CONTAINERS = (
    Container("ros1", ".bag", ROSRECORD, (1,), "mosaico_ingest.rosbag.ros1.version_1_2:RosrecordReader"),
    Container("ros1", ".bag", b"#ROS", (1,), "mosaico_ingest.rosbag.ros1.reader:Ros1Reader"),
    Container(
        "sqlite3",
        ".db3",
        b"SQLite format 3\x00",
        (2,),
        "mosaico_ingest.rosbag.sqlite:SqliteReader",
        by_offset=False,
    ),
    Container("mcap", ".mcap", MCAP, (1, 2), "mosaico_ingest.rosbag.mcap.reader:McapReader"),
)
"""All container formats; the first whose magic matches is used."""

SUFFIXES = tuple(dict.fromkeys(container.suffix for container in CONTAINERS))
ROS_VERSIONS = {container.suffix: container.ros_versions for container in CONTAINERS}
"""The versions of ROS whose messages a container stores, by suffix."""
SUFFIX_LIST = f"{', '.join(SUFFIXES[:-1])} and {SUFFIXES[-1]}"
"""The suffixes as they appear in messages."""
RECORDING_NAME = re.compile(
    rf"({'|'.join(map(re.escape, SUFFIXES))})(\.(zstd|zst|lz4|gz|bz2))?(\.active)?$", re.IGNORECASE
)
"""Matches the end of a recording's file name, compressed or not, finished or not."""


def container_of(head: bytes) -> Container | None:
    """Return the format of a file that starts with `head`; None if it is not a recording."""
    return next((container for container in CONTAINERS if head.startswith(container.magic)), None)
