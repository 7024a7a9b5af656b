"""The rosbags library as the writer of ROS 1 bags and rosbag2 SQLite files, and as the reference that tests of the readers compare with."""

from __future__ import annotations

import keyword
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import Connection as RosbagsConnection
from rosbags.interfaces.typing import Typesdict
from rosbags.rosbag1 import Writer as Rosbag1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2
from rosbags.serde import SerdeError
from rosbags.typesys import Stores as RosbagsStores
from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from mosaico_ingest.containers import SUFFIX_LIST
from mosaico_ingest.errors import BagError, DecodeError
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.blocks import Attachment, Connection, Encoding
from mosaico_ingest.rosbag.definitions.linking import md5sum, rihs01
from mosaico_ingest.rosbag.definitions.model import (
    BYTES,
    Container,
    Definition,
    Language,
    MessageType,
    normalize_msgtype,
)
from mosaico_ingest.rosbag.definitions.rosbags_types import message_type
from mosaico_ingest.rosbag.mcap.writer import McapWriter

_ERRORS = (
    AnyReaderError,
    TypesysError,
    SerdeError,
    AssertionError,
    ArithmeticError,
    LookupError,
    TypeError,
    ValueError,
)
"""Exceptions that rosbags raises for recordings, definitions and messages that it cannot read."""


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


class RosbagsRecording:
    """A recording opened with `rosbags.highlevel.AnyReader`."""

    def __init__(
        self,
        paths: Sequence[Path],
        distro: Stores | None = None,
        definitions: Mapping[str, str] | None = None,
    ) -> None:
        """Open the files; `distro` and `definitions` describe types for recordings without embedded definitions.

        Raises:
            BagError: rosbags cannot open the recording.
        """
        store = get_typestore(RosbagsStores((distro or Stores.EMPTY).value))
        try:
            for msgtype, text in (definitions or {}).items():
                store.register(_types_from_text(msgtype, text))
            self._reader = AnyReader(paths, default_typestore=store if store.fielddefs else None)
            self._reader.open()
        except (*_ERRORS, OSError) as error:
            what = (
                f"rosbags cannot open the recording: {' '.join(str(error).split()) or type(error).__name__}"
            )
            raise BagError(
                what, where=str(paths[0]), hint="use the native reader, or set ros_distro"
            ) from error
        self._rosbags_connections = list(self._reader.connections)
        encoding = Encoding.CDR if self._reader.is2 else Encoding.ROS1
        self.connections = tuple(
            Connection(
                number, one.topic, normalize_msgtype(one.msgtype), encoding, one.msgcount, definition=None
            )
            for number, one in enumerate(self._rosbags_connections)
        )

    def close(self) -> None:
        """Close the files. Closing twice is harmless."""
        if self._reader.stack:
            self._reader.close()

    def time_bounds(self) -> tuple[int, int]:
        """Return the log times of the first and last message, nanoseconds since the epoch."""
        return self._reader.start_time, self._reader.end_time - 1

    def payloads(self, connection_ids: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        """Yield log time, connection id and payload of each message, by log time.

        Raises:
            BagError: rosbags cannot read a part of the recording.
        """
        selected = [self._rosbags_connections[number] for number in connection_ids]
        ids = {id(connection): number for number, connection in enumerate(self._rosbags_connections)}
        try:
            for connection, log_ns, payload in self._reader.messages(selected):
                yield log_ns, ids[id(connection)], bytes(payload)
        except (*_ERRORS, OSError) as error:
            raise BagError(f"rosbags cannot read the recording: {error}") from error

    def deserializer(self, connection: Connection) -> Callable[[bytes], dict[str, Any]]:
        """Return a function that decodes a payload to a dictionary, and raises DecodeError for invalid bytes."""
        msgtype = self._rosbags_connections[connection.id].msgtype

        def deserialize(payload: bytes) -> dict[str, Any]:
            try:
                message = self._reader.deserialize(payload, msgtype)
                return _to_dict(message, msgtype, self._reader.typestore.fielddefs)
            except _ERRORS as error:
                raise DecodeError(f"rosbags: {error}", rule="decode", where=msgtype) from error

        return deserialize


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


def _types_from_text(msgtype: str, text: str) -> Typesdict:
    if "module " in text:
        return get_types_from_idl(text)
    return get_types_from_msg(text, msgtype)


def _to_dict(message: object, msgtype: str, types: Typesdict) -> dict[str, Any]:
    """Return the fields of a rosbags message in the form of `serialization.Deserializer.to_dict`."""
    definition: MessageType = message_type(msgtype, types)
    values: dict[str, Any] = {}
    for field in definition.fields:
        value = getattr(message, f"{field.name}_" if keyword.iskeyword(field.name) else field.name)
        if field.is_message:
            if field.container is Container.SCALAR:
                values[field.name] = _to_dict(value, field.type, types)
            else:
                values[field.name] = [_to_dict(item, field.type, types) for item in value]
        elif field.type in BYTES:
            unsigned = np.asarray(value).astype(np.uint8)  # rosbags reads `byte` as a signed number
            if field.container is Container.SEQUENCE:
                values[field.name] = unsigned.tobytes()
            else:
                values[field.name] = unsigned.tolist()
        else:
            values[field.name] = value.tolist() if isinstance(value, np.ndarray) else value
    return values
