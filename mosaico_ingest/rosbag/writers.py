"""Writers of recordings: MCAP, ROS 1 bags and rosbag2 SQLite files."""

from __future__ import annotations

import shutil
import sqlite3
import struct
import tempfile
import zlib
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import zstandard
from rosbags.interfaces import Connection as RosbagsConnection
from rosbags.rosbag1 import Writer as Rosbag1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.definitions.hashes import md5sum, rihs01
from mosaico_ingest.rosbag.definitions.model import Definition, short_msgtype
from mosaico_ingest.rosbag.formats import MCAP, SUFFIX_LIST
from mosaico_ingest.rosbag.mcap.records import (
    RECORD,
    Op,
    record_bytes,
    text_bytes,
    texts_bytes,
)
from mosaico_ingest.version import __version__

__all__ = [
    "McapWriter",
    "RecordingWriter",
    "Ros1Writer",
    "SqliteWriter",
    "open_writer",
]


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

    def finish(self) -> None:
        """Write the index and close the file."""
        ...

    def abandon(self) -> None:
        """Close the unfinished file."""
        ...


_CHUNK_BYTES = 4 << 20
_MESSAGE = struct.Struct("<HIQQ")
_MAX_CHANNELS = 65535


@dataclass(slots=True)
class _Chunk:
    """The content of the chunk being written."""

    data: bytearray = field(default_factory=bytearray)
    index: dict[int, bytearray] = field(default_factory=dict[int, bytearray])
    """Log time and offset of each message, by channel."""
    start_ns: int = 0
    end_ns: int = 0


class McapWriter:
    """Writes one MCAP file; satisfies `RecordingWriter`."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("xb")
        self._schemas: dict[tuple[str, int, str], int] = {}
        self._records: list[bytes] = []
        """Schema and channel records, which precede the first chunk that refers to them and are repeated in the summary."""
        self._versions: list[int] = []
        self._counts: dict[int, int] = {}
        self._pending: list[bytes] = []
        self._chunk = _Chunk()
        self._chunk_indexes: list[bytes] = []
        self._start_ns: int | None = None
        self._end_ns = 0
        self._file.write(MCAP)
        self._has_header = False

    def add_connection(
        self,
        topic: str,
        definition: Definition,
        *,
        embed: bool = True,
        metadata: Mapping[str, str] | None = None,
    ) -> int:
        """Add a connection; two definitions of one type are two schemas. Without `embed` the schema has no text."""
        if len(self._versions) == _MAX_CHANNELS:
            raise BagError(f"an MCAP file can have at most {_MAX_CHANNELS} channels", where=topic)
        number, version = len(self._versions) + 1, definition.ros_version
        self._versions.append(version)
        encoding = "ros1" if version == 1 else "cdr"
        schema = self._schema(definition, definition.text if embed else "")
        content = struct.pack("<HH", number, schema) + text_bytes(topic) + text_bytes(encoding)
        self._add(Op.CHANNEL, content + texts_bytes(dict(metadata or {})))
        self._counts[number] = 0
        return number

    def write(self, channel: int, log_ns: int, payload: bytes) -> None:
        """Append a message; its publish time is unknown, so the log time is used."""
        self._write_pending()
        chunk = self._chunk
        if not chunk.data:
            chunk.start_ns = chunk.end_ns = log_ns
        chunk.start_ns, chunk.end_ns = min(chunk.start_ns, log_ns), max(chunk.end_ns, log_ns)
        chunk.index.setdefault(channel, bytearray()).extend(struct.pack("<QQ", log_ns, len(chunk.data)))
        chunk.data += RECORD.pack(Op.MESSAGE, _MESSAGE.size + len(payload))
        chunk.data += _MESSAGE.pack(channel, self._counts[channel] & 0xFFFFFFFF, log_ns, log_ns)
        chunk.data += payload
        self._counts[channel] += 1
        self._start_ns = log_ns if self._start_ns is None else min(self._start_ns, log_ns)
        self._end_ns = max(self._end_ns, log_ns)
        if len(chunk.data) >= _CHUNK_BYTES:
            self._flush()

    def finish(self) -> None:
        """Write the last chunk and the summary."""
        self._write_pending()
        self._flush()
        self._put(Op.DATA_END, struct.pack("<I", 0))
        start = self._file.tell()
        groups = [
            (Op.SCHEMA, [record for record in self._records if record[0] == Op.SCHEMA]),
            (Op.CHANNEL, [record for record in self._records if record[0] == Op.CHANNEL]),
            (Op.STATISTICS, [record_bytes(Op.STATISTICS, self._statistics())]),
            (Op.CHUNK_INDEX, self._chunk_indexes),
        ]
        summary, offsets = b"", b""
        for op, records in groups:
            group = b"".join(records)
            if group:
                entry = struct.pack("<BQQ", op, start + len(summary), len(group))
                offsets += record_bytes(Op.SUMMARY_OFFSET, entry)
                summary += group
        footer = RECORD.pack(Op.FOOTER, 20) + struct.pack("<QQ", start, start + len(summary))
        checked = summary + offsets + footer
        self._file.write(checked + struct.pack("<I", zlib.crc32(checked)) + MCAP)
        self._file.close()

    def abandon(self) -> None:
        """Close the unfinished file."""
        self._file.close()

    def _write_pending(self) -> None:
        """Write the header, which depends on the ROS versions of the channels, and the channels added since."""
        if not self._has_header:
            versions = set(self._versions)
            profile = f"ros{versions.pop()}" if len(versions) == 1 else ""
            self._put(Op.HEADER, text_bytes(profile) + text_bytes(f"mosaico-ingest {__version__}"))
            self._has_header = True
        for record in self._pending:
            self._file.write(record)
        self._pending.clear()

    def _schema(self, definition: Definition, text: str) -> int:
        version = definition.ros_version
        key = (definition.root, version, text)
        if key not in self._schemas:
            number = self._schemas[key] = len(self._schemas) + 1
            name = short_msgtype(definition.root) if version == 1 else definition.root
            data = text.encode()
            content = struct.pack("<H", number) + text_bytes(name) + text_bytes(f"ros{version}msg")
            self._add(Op.SCHEMA, content + struct.pack("<I", len(data)) + data)
        return self._schemas[key]

    def _add(self, op: int, content: bytes) -> None:
        record = record_bytes(op, content)
        self._records.append(record)
        self._pending.append(record)

    def _put(self, op: int, content: bytes) -> int:
        """Write a record and return its offset."""
        at = self._file.tell()
        self._file.write(record_bytes(op, content))
        return at

    def _flush(self) -> None:
        chunk, self._chunk = self._chunk, _Chunk()
        if not chunk.data:
            return
        data = bytes(chunk.data)
        packed = zstandard.compress(data, 3)
        span = struct.pack("<QQ", chunk.start_ns, chunk.end_ns)
        head = span + struct.pack("<QI", len(data), zlib.crc32(data)) + text_bytes("zstd")
        at = self._put(Op.CHUNK, head + struct.pack("<Q", len(packed)) + packed)
        length = self._file.tell() - at
        index_offsets = b""
        for channel, entries in chunk.index.items():
            offset = self._put(Op.MESSAGE_INDEX, struct.pack("<HI", channel, len(entries)) + entries)
            index_offsets += struct.pack("<HQ", channel, offset)
        content = (
            span + struct.pack("<QQ", at, length) + struct.pack("<I", len(index_offsets)) + index_offsets
        )
        content += struct.pack("<Q", self._file.tell() - at - length) + text_bytes("zstd")
        content += struct.pack("<QQ", len(packed), len(data))
        self._chunk_indexes.append(record_bytes(Op.CHUNK_INDEX, content))

    def _statistics(self) -> bytes:
        counts = b"".join(struct.pack("<HQ", channel, count) for channel, count in self._counts.items())
        return (
            struct.pack("<QHI", sum(self._counts.values()), len(self._schemas), len(self._versions))
            + struct.pack("<II", 0, 0)
            + struct.pack("<I", len(self._chunk_indexes))
            + struct.pack("<QQ", self._start_ns or 0, self._end_ns)
            + struct.pack("<I", len(counts))
            + counts
        )


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


@contextmanager
def open_writer(path: Path, *, replace: bool = False) -> Generator[RecordingWriter]:
    """Open a writer for the container of the file's suffix; an exception leaves no file behind.

    Raises:
        BagError: The suffix is unknown, the file exists, or it cannot be written.
    """
    make = _WRITERS.get(path.suffix)
    if make is None:
        raise BagError("no container has this suffix", where=str(path), hint=f"use one of {SUFFIX_LIST}")
    if path.exists() and not replace:
        raise BagError("the file exists", where=str(path), hint="choose another name, or use --force")
    if path.is_dir():
        raise BagError("it is a folder", where=str(path), hint="choose another name")
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
