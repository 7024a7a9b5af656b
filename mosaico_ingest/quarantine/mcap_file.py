"""This file writes messages as they are into an MCAP file."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from typing_extensions import Self

from mosaico_ingest.bag.batch import Channel, Encoding
from mosaico_ingest.bag.containers.magics import MCAP
from mosaico_ingest.bag.containers.mcap_records import RECORD, Op, record_bytes, text_bytes, texts_bytes
from mosaico_ingest.bag.definition import Definition, Source
from mosaico_ingest.bag.names import short_msgtype

__all__ = ["McapFile"]

_MESSAGE_HEAD = struct.Struct("<HIQQ")
_LIBRARY = "mosaico-ingest"


class McapFile:
    """A new MCAP file without chunks.

    A definition that came from the recording goes along; another is looked for anew by whoever reads the file.
    """

    def __init__(self, path: Path) -> None:
        """Create the file.

        Raises:
            OSError: It cannot be created, or is there already.
        """
        self._file: BinaryIO = path.open("xb")
        self._channels: dict[int, bytes] = {}
        self._schemas: dict[int, bytes] = {}
        self._counts: dict[int, int] = {}
        self._span: tuple[int, int] | None = None
        self._file.write(MCAP)
        self._put(Op.HEADER, text_bytes("") + text_bytes(_LIBRARY))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def write(self, channel: Channel, log_time_ns: int, payload: bytes) -> None:
        """Append one message; OSError where the disk refuses it."""
        number = channel.id
        if number not in self._channels:
            self._open(channel)
        count = self._counts[number] = self._counts.get(number, 0) + 1
        head = _MESSAGE_HEAD.pack(number + 1, count, log_time_ns, log_time_ns)
        self._put(Op.MESSAGE, head + payload)
        low, high = self._span or (log_time_ns, log_time_ns)
        self._span = min(low, log_time_ns), max(high, log_time_ns)

    def close(self) -> None:
        """Write the summary and close the file; twice does no harm."""
        if self._file.closed:
            return
        self._put(Op.DATA_END, struct.pack("<I", 0))
        start = self._file.tell()
        summary = b"".join((*self._schemas.values(), *self._channels.values(), self._statistics()))
        self._file.write(summary)
        footer = RECORD.pack(Op.FOOTER, 20) + struct.pack("<QQ", start, 0)
        crc = zlib.crc32(summary + footer)
        self._file.write(footer + struct.pack("<I", crc) + MCAP)
        self._file.close()

    def _open(self, channel: Channel) -> None:
        number = channel.id + 1
        ros1 = channel.encoding is Encoding.ROS1
        known = channel.definition
        embedded = known is not None and known.source is Source.BAG
        schema = struct.pack("<H", number) + text_bytes(_schema_name(channel, known))
        schema += text_bytes("ros1msg" if ros1 else "ros2msg") + text_bytes(
            known.text if known and embedded else ""
        )
        kept = {key: value for key, value in channel.attributes.items() if key == "offered_qos_profiles"}
        body = (
            struct.pack("<HH", number, number)
            + text_bytes(channel.topic)
            + text_bytes(channel.encoding.value)
        )
        self._schemas[channel.id] = record_bytes(Op.SCHEMA, schema)
        self._channels[channel.id] = record_bytes(Op.CHANNEL, body + texts_bytes(kept))
        self._file.write(self._schemas[channel.id] + self._channels[channel.id])

    def _statistics(self) -> bytes:
        low, high = self._span or (0, 0)
        counts = b"".join(struct.pack("<HQ", number + 1, count) for number, count in self._counts.items())
        head = struct.pack(
            "<QHIIIIQQI",
            sum(self._counts.values()),
            len(self._schemas),
            len(self._channels),
            0,
            0,
            0,
            low,
            high,
            len(counts),
        )
        return record_bytes(Op.STATISTICS, head + counts)

    def _put(self, kind: int, body: bytes) -> None:
        self._file.write(record_bytes(kind, body))


def _schema_name(channel: Channel, known: Definition | None) -> str:
    name = known.root if known is not None else channel.msgtype
    return short_msgtype(name) if channel.encoding is Encoding.ROS1 else name
