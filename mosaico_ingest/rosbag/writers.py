"""Writers of recordings: ROS 1 bags and rosbag2 SQLite files by rosbags, and the choice of a writer by suffix."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol, runtime_checkable

from rosbags.interfaces import Connection as RosbagsConnection
from rosbags.rosbag1 import Writer as Rosbag1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2

from mosaico_ingest.containers import SUFFIX_LIST
from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.attachments import Attachment
from mosaico_ingest.rosbag.definitions.hashes import md5sum, rihs01
from mosaico_ingest.rosbag.definitions.model import Definition, Language
from mosaico_ingest.rosbag.mcap.writer import McapWriter


class RecordingWriter(Protocol):
    """Writes messages in log-time order: ROS 1 messages in the ROS 1 encoding, others as little-endian CDR."""

    def add_connection(self, topic: str, definition: Definition) -> int:
        """Add a connection and return its number.

        Raises:
            BagError: The container cannot store it.
        """
        ...

    def write(self, channel: int, log_ns: int, payload: bytes) -> None:
        """Append a message."""
        ...

    def set_custom_data(self, custom_data: Mapping[str, str]) -> None:
        """Set the `custom_data` of rosbag2.

        Raises:
            BagError: The container cannot store it.
        """
        ...

    def finish(self) -> None:
        """Write the index and close the file."""
        ...

    def abandon(self) -> None:
        """Close the unfinished file."""
        ...


@runtime_checkable
class AttachmentWriter(Protocol):
    """A writer whose container stores attachments and metadata records."""

    def add_metadata(self, name: str, entries: Iterable[tuple[str, str]]) -> None:
        """Write a metadata record."""
        ...

    def add_attachment(self, attachment: Attachment, chunks: Iterable[bytes]) -> None:
        """Write an attachment with its checksum.

        Raises:
            BagError: The chunks do not have the size of the attachment.
        """
        ...


class SqliteWriter:
    """Writes one `.db3` file; satisfies `RecordingWriter`."""

    def __init__(self, path: Path) -> None:
        self._path = path
        folder = path.with_name(f"{path.stem}.folder") / path.stem
        folder.parent.mkdir()
        self._bag = Rosbag2(folder, version=9, storage_plugin=StoragePlugin.SQLITE3)
        self._bag.open()
        self._connections: list[RosbagsConnection] = []
        self._texts: dict[str, str] = {}

    def add_connection(self, topic: str, definition: Definition) -> int:
        """Add a connection; a `.db3` file stores one definition per type, and only ROS 2 types."""
        if definition.language is not Language.ROS:
            raise _not_ros(topic, definition)
        if definition.ros_version == 1:
            raise BagError(f"{definition.root} is a ROS 1 type", where=topic, hint="write .mcap or .bag")
        if self._texts.setdefault(definition.root, definition.text) != definition.text:
            what = f"the recording has another definition of {definition.root}, and .db3 stores one per type"
            raise BagError(what, where=topic, hint="write .mcap")
        try:
            digest = rihs01(definition)
        except BagError as error:
            raise BagError(f"{error.what}, which .db3 requires", where=topic, hint="write .mcap") from error
        opened = self._bag.add_connection(topic, definition.root, msgdef=definition.text, rihs01=digest)
        self._connections.append(opened)
        return len(self._connections) - 1

    def write(self, channel: int, log_ns: int, payload: bytes) -> None:
        """Append a message."""
        self._bag.write(self._connections[channel], log_ns, payload)

    def set_custom_data(self, custom_data: Mapping[str, str]) -> None:
        """Set the `custom_data` of rosbag2, which the copy of `metadata.yaml` in the database contains."""
        for key, value in custom_data.items():
            self._bag.set_custom_data(key, value)

    def finish(self) -> None:
        """Close the database and move it out of its folder."""
        self._bag.close()
        next(self._bag.path.glob("*.db3")).replace(self._path)

    def abandon(self) -> None:
        """Close the unfinished database."""
        self._bag.abort()


class Ros1Writer:
    """Writes one ROS 1 bag; satisfies `RecordingWriter`."""

    def __init__(self, path: Path) -> None:
        self._bag = Rosbag1(path)
        self._bag.set_compression(Rosbag1.CompressionFormat.LZ4)
        self._bag.open()
        self._connections: list[RosbagsConnection] = []

    def add_connection(self, topic: str, definition: Definition) -> int:
        """Add a connection; a bag stores only ROS 1 types."""
        if definition.language is not Language.ROS:
            raise _not_ros(topic, definition)
        if definition.ros_version != 1:
            raise BagError(f"{definition.root} is a ROS 2 type", where=topic, hint="write .mcap or .db3")
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

    def set_custom_data(self, custom_data: Mapping[str, str]) -> None:
        """Raise BagError: a bag has no `custom_data`."""
        raise BagError(f"a bag has no custom_data: {', '.join(custom_data)}", hint="write .mcap or .db3")

    def finish(self) -> None:
        """Write the index."""
        self._bag.close()

    def abandon(self) -> None:
        """Close the unfinished file."""
        self._bag.abort()


_WRITERS: dict[str, Callable[[Path], RecordingWriter]] = {
    ".mcap": McapWriter,
    ".db3": SqliteWriter,
    ".bag": Ros1Writer,
}


def check_new_recording(path: Path, *, replace: bool = False) -> None:
    """Check that a recording can be created at a path.

    Raises:
        BagError: The suffix is unknown, or the file exists.
    """
    if path.suffix not in _WRITERS:
        raise BagError("no container has this suffix", where=str(path), hint=f"use one of {SUFFIX_LIST}")
    if path.exists() and not replace:
        raise BagError("the file exists", where=str(path), hint="choose another name, or use --force")
    if path.is_dir():
        raise BagError("it is a folder", where=str(path), hint="choose another name")


@contextmanager
def open_writer(path: Path, *, replace: bool = False) -> Generator[RecordingWriter]:
    """Open a writer for the container of the file's suffix; an exception leaves no file behind.

    Raises:
        BagError: The suffix is unknown, the file exists, or it cannot be written.
    """
    check_new_recording(path, replace=replace)
    make = _WRITERS[path.suffix]
    try:
        folder = Path(tempfile.mkdtemp(prefix=f".{path.stem}-", dir=path.parent))
    except OSError as error:
        raise BagError(f"cannot be written: {error.strerror}", where=str(path)) from error
    try:
        part = folder / path.name
        writer = make(part)
        try:
            yield writer
            writer.finish()
        except BaseException:
            writer.abandon()
            raise
        part.replace(path)
    except (OSError, sqlite3.Error) as error:
        raise BagError(f"cannot be written: {error}", where=str(path)) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _not_ros(topic: str, definition: Definition) -> BagError:
    message = f"{definition.root} is a {definition.language.value} type, not a ROS type"
    return BagError(message, where=topic, hint="write .mcap")
