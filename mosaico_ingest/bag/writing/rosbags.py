"""This file writes ROS 1 bags and rosbag2's SQLite files, by way of rosbags."""

from __future__ import annotations

from pathlib import Path

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer as Rosbag1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2

from mosaico_ingest.bag.definition import Definition
from mosaico_ingest.bag.hashes import md5sum, rihs01
from mosaico_ingest.errors import BagError

__all__ = ["Ros1Writer", "SqliteWriter"]


class SqliteWriter:
    """Writes one `.db3` file; satisfies `RecordingWriter`."""

    def __init__(self, path: Path) -> None:
        self._path = path
        folder = path.with_name(f"{path.stem}.folder") / path.stem
        folder.parent.mkdir()
        self._bag = Rosbag2(folder, version=9, storage_plugin=StoragePlugin.SQLITE3)
        self._bag.open()
        self._connections: list[Connection] = []
        self._texts: dict[str, str] = {}

    def channel(self, topic: str, definition: Definition) -> int:
        """Open a channel; a `.db3` file holds one definition of a type, and none of ROS 1."""
        if definition.ros_version == 1:
            raise BagError(f"{definition.root} is of ROS 1", where=topic, hint="write .mcap or .bag")
        if self._texts.setdefault(definition.root, definition.text) != definition.text:
            what = f"there is another definition of {definition.root}, and .db3 holds one"
            raise BagError(what, where=topic, hint="write .mcap")
        try:
            digest = rihs01(definition)
        except BagError as error:
            raise BagError(f"{error.what}, as .db3 wants it", where=topic, hint="write .mcap") from error
        opened = self._bag.add_connection(topic, definition.root, msgdef=definition.text, rihs01=digest)
        self._connections.append(opened)
        return len(self._connections) - 1

    def write(self, channel: int, log_ns: int, payload: bytes) -> None:
        """Append a message."""
        self._bag.write(self._connections[channel], log_ns, payload)

    def finish(self) -> None:
        """Close the database and take it out of its folder."""
        self._bag.close()
        next(self._bag.path.glob("*.db3")).replace(self._path)

    def abandon(self) -> None:
        """Close the database as it is."""
        self._bag.abort()


class Ros1Writer:
    """Writes one ROS 1 bag; satisfies `RecordingWriter`."""

    def __init__(self, path: Path) -> None:
        self._bag = Rosbag1(path)
        self._bag.set_compression(Rosbag1.CompressionFormat.LZ4)
        self._bag.open()
        self._connections: list[Connection] = []

    def channel(self, topic: str, definition: Definition) -> int:
        """Open a channel; a bag holds no definitions of ROS 2."""
        if definition.ros_version != 1:
            raise BagError(f"{definition.root} is of ROS 2", where=topic, hint="write .mcap or .db3")
        try:
            digest = md5sum(definition)
        except BagError as error:
            raise BagError(error.what, where=topic) from error
        opened = self._bag.add_connection(topic, definition.root, msgdef=definition.text, md5sum=digest)
        self._connections.append(opened)
        return len(self._connections) - 1

    def write(self, channel: int, log_ns: int, payload: bytes) -> None:
        """Append a message."""
        self._bag.write(self._connections[channel], log_ns, payload)

    def finish(self) -> None:
        """Write the index."""
        self._bag.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._bag.abort()
