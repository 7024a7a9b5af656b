"""The writer of MCAP files: Zstandard chunks with indexes, statistics and checksums."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path

import zstandard
from msgspec import Struct, field

from mosaico_ingest.containers import MCAP
from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.blocks import Attachment
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded, short_msgtype
from mosaico_ingest.rosbag.encodings import MESSAGE_ENCODINGS, encoding_of
from mosaico_ingest.rosbag.mcap.index import RECORD, Op, record_bytes, text_bytes, texts_bytes
from mosaico_ingest.version import __version__

_CHUNK_BYTES = 4 << 20
_MESSAGE = struct.Struct("<HIQQ")
_MAX_CHANNELS = 65535
_NO_SCHEMA = 0
"""The schema id of channels without a schema, such as JSON without a JSON Schema."""


class _Chunk(Struct):
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
        self._topics: list[tuple[str, str, str]] = []
        """Topic, type and encoding of each channel."""
        self._custom_data: dict[str, str] = {}
        self._metadata_indexes: list[bytes] = []
        self._attachment_indexes: list[bytes] = []

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
        number = len(self._versions) + 1
        self._versions.append(definition.ros_version)
        schema = self._schema(definition, definition.text if embed else "")
        encoding = encoding_of(definition).value
        content = struct.pack("<HH", number, schema) + text_bytes(topic) + text_bytes(encoding)
        self._add(Op.CHANNEL, content + texts_bytes(dict(metadata or {})))
        self._counts[number] = 0
        self._topics.append((topic, definition.root, encoding))
        return number

    def add_metadata(self, name: str, entries: Iterable[tuple[str, str]]) -> None:
        """Write a metadata record."""
        self._write_pending()
        content = text_bytes(name) + texts_bytes(dict(entries))
        at = self._put(Op.METADATA, content)
        entry = struct.pack("<QQ", at, self._file.tell() - at) + text_bytes(name)
        self._metadata_indexes.append(record_bytes(Op.METADATA_INDEX, entry))

    def add_attachment(self, attachment: Attachment, chunks: Iterable[bytes]) -> None:
        """Write an attachment with its checksum.

        Raises:
            BagError: The chunks do not have the size of the attachment.
        """
        self._write_pending()
        head = struct.pack("<QQ", attachment.log_ns, attachment.create_ns)
        head += text_bytes(attachment.name) + text_bytes(attachment.media_type)
        head += struct.pack("<Q", attachment.size_bytes)
        at = self._file.tell()
        self._file.write(RECORD.pack(Op.ATTACHMENT, len(head) + attachment.size_bytes + 4) + head)
        crc, size = zlib.crc32(head), 0
        for chunk in chunks:
            self._file.write(chunk)
            crc = zlib.crc32(chunk, crc)
            size += len(chunk)
        if size != attachment.size_bytes:
            what = f"the attachment {attachment.name!r} has {size} bytes instead of {attachment.size_bytes}"
            raise BagError(what)
        self._file.write(struct.pack("<I", crc if attachment.has_crc else 0))
        entry = struct.pack("<QQ", at, self._file.tell() - at)
        entry += struct.pack("<QQQ", attachment.log_ns, attachment.create_ns, attachment.size_bytes)
        entry += text_bytes(attachment.name) + text_bytes(attachment.media_type)
        self._attachment_indexes.append(record_bytes(Op.ATTACHMENT_INDEX, entry))

    def set_custom_data(self, custom_data: Mapping[str, str]) -> None:
        """Set the `custom_data` of rosbag2, which the copy of `metadata.yaml` in the file contains."""
        self._custom_data = dict(custom_data)

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
        if self._custom_data:
            self.add_metadata("rosbag2", [("serialized_metadata", self._rosbag2_metadata())])
        self._put(Op.DATA_END, struct.pack("<I", 0))
        start = self._file.tell()
        groups = [
            (Op.SCHEMA, [record for record in self._records if record[0] == Op.SCHEMA]),
            (Op.CHANNEL, [record for record in self._records if record[0] == Op.CHANNEL]),
            (Op.STATISTICS, [record_bytes(Op.STATISTICS, self._statistics())]),
            (Op.CHUNK_INDEX, self._chunk_indexes),
            (Op.ATTACHMENT_INDEX, self._attachment_indexes),
            (Op.METADATA_INDEX, self._metadata_indexes),
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
            version = versions.pop() if len(versions) == 1 else 0
            profile = f"ros{version}" if version else ""
            self._put(Op.HEADER, text_bytes(profile) + text_bytes(f"mosaico-ingest {__version__}"))
            self._has_header = True
        for record in self._pending:
            self._file.write(record)
        self._pending.clear()

    def _schema(self, definition: Definition, text: str) -> int:
        version = definition.ros_version
        language = MESSAGE_ENCODINGS[encoding_of(definition)].schema_encoding
        if language and not definition.text:
            return _NO_SCHEMA
        key = (definition.root, version, text)
        if key not in self._schemas:
            number = self._schemas[key] = len(self._schemas) + 1
            name = short_msgtype(definition.root) if version == 1 else definition.root
            embedded = Embedded(language or f"ros{version}msg", text)
            data = embedded.to_bytes()
            content = struct.pack("<H", number) + text_bytes(name) + text_bytes(embedded.encoding)
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

    def _rosbag2_metadata(self) -> str:
        """Return a `metadata.yaml` in JSON, which is YAML."""
        start_ns = self._start_ns or 0
        information = {
            "version": 9,
            "storage_identifier": "mcap",
            "relative_file_paths": [],
            "duration": {"nanoseconds": self._end_ns - start_ns},
            "starting_time": {"nanoseconds_since_epoch": start_ns},
            "message_count": sum(self._counts.values()),
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic,
                        "type": msgtype,
                        "serialization_format": encoding,
                        "offered_qos_profiles": [],
                        "type_description_hash": "",
                    },
                    "message_count": self._counts[number],
                }
                for number, (topic, msgtype, encoding) in enumerate(self._topics, 1)
            ],
            "compression_format": "",
            "compression_mode": "",
            "files": [],
            "custom_data": self._custom_data,
            "ros_distro": "",
        }
        return json.dumps({"rosbag2_bagfile_information": information})

    def _statistics(self) -> bytes:
        counts = b"".join(struct.pack("<HQ", channel, count) for channel, count in self._counts.items())
        return (
            struct.pack("<QHI", sum(self._counts.values()), len(self._schemas), len(self._versions))
            + struct.pack("<II", len(self._attachment_indexes), len(self._metadata_indexes))
            + struct.pack("<I", len(self._chunk_indexes))
            + struct.pack("<QQ", self._start_ns or 0, self._end_ns)
            + struct.pack("<I", len(counts))
            + counts
        )
