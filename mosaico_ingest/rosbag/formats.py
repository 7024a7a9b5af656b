"""The table of container formats, used by detection, discovery, lint, the writers and the command line.

To add a container format, write a reader that satisfies `blocks.SplitReader` and add a row to `CONTAINERS`. This module
imports readers only when they are needed, so that importing it is cheap.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING

from msgspec import Struct

if TYPE_CHECKING:
    from pathlib import Path

    from mosaico_ingest.remote import AnyPath
    from mosaico_ingest.rosbag.blocks import SplitReader
    from mosaico_ingest.rosbag.source import Source

__all__ = [
    "CONTAINERS",
    "MCAP",
    "RECORDING_NAME",
    "ROSRECORD",
    "ROS_VERSIONS",
    "SUFFIXES",
    "SUFFIX_LIST",
    "ZSTD",
    "ZSTD_SUFFIX",
    "Container",
    "container_of",
]


def _open_mcap(source: Source, max_chunk_bytes: int) -> SplitReader:
    from mosaico_ingest.rosbag.mcap.reader import McapReader

    return McapReader(source, max_chunk_bytes)


def _open_ros1(source: Source, max_chunk_bytes: int) -> SplitReader:
    from mosaico_ingest.rosbag.ros1.reader import Ros1Reader

    return Ros1Reader(source, max_chunk_bytes)


def _open_rosrecord(source: Source, max_chunk_bytes: int) -> SplitReader:  # noqa: ARG001 - it has no chunks
    from mosaico_ingest.rosbag.ros1.version_1_2 import RosrecordReader

    return RosrecordReader(source)


def _open_sqlite(path: Path, name: AnyPath) -> SplitReader:
    from mosaico_ingest.rosbag.sqlite import SqliteReader

    return SqliteReader(path, name)


class Container(Struct, frozen=True):
    """A container format."""

    name: str
    """The name that reports and inspections show."""
    suffix: str
    magic: bytes
    """The first bytes of every file of this format."""
    ros_versions: tuple[int, ...]
    """The versions of ROS whose messages the container can store."""
    open_source: Callable[[Source, int], SplitReader] | None = None
    """Opens a file that is read by offset, and can therefore be read in place from a URL.

    Takes the file and the maximum decompressed size of a chunk in bytes."""
    open_path: Callable[[Path, AnyPath], SplitReader] | None = None
    """Opens a file that must be on a local disk; takes its path and the path to show in messages."""


MCAP = b"\x89MCAP0\r\n"
ROSRECORD = b"#ROSRECORD V1.2"
ZSTD = b"\x28\xb5\x2f\xfd"
ZSTD_SUFFIX = ".zstd"
"""Suffix of files that rosbag2 compressed as a whole; every container may be compressed."""

CONTAINERS = (
    Container("ros1", ".bag", ROSRECORD, (1,), open_source=_open_rosrecord),
    Container("ros1", ".bag", b"#ROS", (1,), open_source=_open_ros1),
    Container("sqlite3", ".db3", b"SQLite format 3\x00", (2,), open_path=_open_sqlite),
    Container("mcap", ".mcap", MCAP, (1, 2), open_source=_open_mcap),
)
"""All container formats; the first whose magic matches is used."""

SUFFIXES = tuple(dict.fromkeys(container.suffix for container in CONTAINERS))
ROS_VERSIONS = {container.suffix: container.ros_versions for container in CONTAINERS}
"""The versions of ROS whose messages a container stores, by suffix."""
SUFFIX_LIST = f"{', '.join(SUFFIXES[:-1])} and {SUFFIXES[-1]}"
"""The suffixes as they appear in messages."""
RECORDING_NAME = re.compile(
    rf"({'|'.join(map(re.escape, SUFFIXES))})(\.(zstd|zst|lz4|gz|bz2))?$", re.IGNORECASE
)
"""Matches the end of a recording's file name, compressed or not."""


def container_of(head: bytes) -> Container | None:
    """Return the format of a file that starts with `head`; None if it is not a recording."""
    return next((container for container in CONTAINERS if head.startswith(container.magic)), None)
