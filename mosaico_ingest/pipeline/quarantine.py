"""Quarantine of rejected messages: bytes in an MCAP file, reasons in a JSONL file."""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
import zlib
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, TextIO

from msgspec import Struct
from typing_extensions import Self

from mosaico_ingest.errors import BagError, NothingMatched, SinkError
from mosaico_ingest.findings import RowFailure, Stage
from mosaico_ingest.job.config import QuarantineSettings
from mosaico_ingest.job.values import Limit
from mosaico_ingest.rosbag.blocks import Connection, Encoding, MessageBlock
from mosaico_ingest.rosbag.definitions.model import Definition, Source, short_msgtype
from mosaico_ingest.rosbag.formats import MCAP
from mosaico_ingest.rosbag.mcap.records import (
    RECORD,
    Op,
    record_bytes,
    text_bytes,
    texts_bytes,
)

__all__ = [
    "INDEX",
    "MESSAGES",
    "Kept",
    "McapFile",
    "Quarantine",
    "find_kept",
    "kept_name",
    "retire",
]

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
        self._connections: dict[int, bytes] = {}
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

    def write(self, connection: Connection, log_time_ns: int, payload: bytes) -> None:
        """Append one message; OSError where the disk refuses it."""
        number = connection.id
        if number not in self._connections:
            self._open(connection)
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
        summary = b"".join((*self._schemas.values(), *self._connections.values(), self._statistics()))
        self._file.write(summary)
        footer = RECORD.pack(Op.FOOTER, 20) + struct.pack("<QQ", start, 0)
        crc = zlib.crc32(summary + footer)
        self._file.write(footer + struct.pack("<I", crc) + MCAP)
        self._file.close()

    def _open(self, connection: Connection) -> None:
        number = connection.id + 1
        ros1 = connection.encoding is Encoding.ROS1
        known = connection.definition
        embedded = known is not None and known.source is Source.BAG
        schema = struct.pack("<H", number) + text_bytes(_schema_name(connection, known))
        schema += text_bytes("ros1msg" if ros1 else "ros2msg") + text_bytes(
            known.text if known and embedded else ""
        )
        kept = {key: value for key, value in connection.attributes.items() if key == "offered_qos_profiles"}
        body = (
            struct.pack("<HH", number, number)
            + text_bytes(connection.topic)
            + text_bytes(connection.encoding.value)
        )
        self._schemas[connection.id] = record_bytes(Op.SCHEMA, schema)
        self._connections[connection.id] = record_bytes(Op.CHANNEL, body + texts_bytes(kept))
        self._file.write(self._schemas[connection.id] + self._connections[connection.id])

    def _statistics(self) -> bytes:
        low, high = self._span or (0, 0)
        counts = b"".join(struct.pack("<HQ", number + 1, count) for number, count in self._counts.items())
        head = struct.pack(
            "<QHIIIIQQI",
            sum(self._counts.values()),
            len(self._schemas),
            len(self._connections),
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


def _schema_name(connection: Connection, known: Definition | None) -> str:
    name = known.root if known is not None else connection.msgtype
    return short_msgtype(name) if connection.encoding is Encoding.ROS1 else name


class Kept(Struct, frozen=True):
    """The messages one run kept, and the sequence they belong to."""

    messages: Path
    sequence: str

    def mark_replayed(self) -> None:
        """Rename the messages, so that the next replay leaves them alone."""
        retire(self.messages, "replayed")


def find_kept(folder: Path) -> tuple[Kept, ...]:
    """Return what lies in a quarantine, the oldest of a sequence first.

    Raises:
        NothingMatched: It is empty.
        BagError: The index beside the messages is not there or cannot be read.
    """
    found = tuple(_kept(folder))
    if not found:
        raise NothingMatched(
            "there is nothing to replay", where=str(folder), hint="name a quarantine's folder"
        )
    return found


def _kept(folder: Path) -> Iterator[Kept]:
    for messages in sorted(folder.glob(f"*{MESSAGES}")):
        index = messages.with_suffix(INDEX)
        try:
            with index.open(encoding="utf-8") as lines:
                first = lines.readline()
            if first.endswith("\n"):  # else its run was killed before it had kept a message
                yield Kept(messages, str(json.loads(first)["sequence"]))
        except (OSError, ValueError, KeyError, TypeError) as error:
            why = getattr(error, "strerror", None) or error
            raise BagError(f"this is no index of a quarantine: {why}", where=str(index)) from error


MESSAGES = ".mcap"
INDEX = ".jsonl"


def kept_name(sequence: str) -> str:
    """Return the name of the file a run that begins now keeps its messages in."""
    stamp = datetime.now(timezone.utc).strftime("%Y%m%dT%H%M%S%fZ")
    return f"{sequence}-{stamp}{MESSAGES}"


class Quarantine:
    """The rejected messages of one run; its two files are made with the first of them."""

    def __init__(
        self, settings: QuarantineSettings, sequence: str, promised: int | None, *, name: str | None = None
    ) -> None:
        """`promised` is how many messages the index promises for the whole run, None where it does not say."""
        self.systematic = settings.systematic
        self.messages_path = settings.path / (name or kept_name(sequence))
        self.kept = 0
        self._settings = settings
        self._sequence = sequence
        self._promised = promised
        self._of_topic: Counter[str] = Counter()
        self._files: tuple[McapFile, TextIO] | None = None

    def take(
        self,
        connection: Connection,
        batch: MessageBlock,
        failure: RowFailure,
        *,
        stage: Stage,
        target: str,
        promised: int | None,
        read: int,
    ) -> bool:
        """Keep one message of `batch`, unless its topic or the run has too many; say whether it was kept.

        `promised` and `read` are the topic's: what its index promises, and how many were read so far.

        Raises:
            SinkError: The files cannot be written.
        """
        topic_limit, run_limit = self._settings.max, self._settings.max_run
        if not _allows(topic_limit, self._of_topic[target], promised, read):
            return False
        if not _allows(run_limit, self.kept, self._promised, read):
            return False
        with self._explained():
            messages, index = self._files or self._create()
            row = failure.row
            messages.write(connection, int(batch.log_times[row]), batch.payload(row))
            index.write(
                json.dumps(self._entry(connection, batch, failure, stage, target), ensure_ascii=False) + "\n"
            )
        self._of_topic[target] += 1
        self.kept += 1
        return True

    def close(self) -> None:
        """Finish the files and wait until they are on the disk: what is committed next says that they are there."""
        with self._explained():
            if self._files is not None:
                for file in self._files:
                    file.close()
                for path in (self.messages_path, self.messages_path.with_suffix(INDEX)):
                    with path.open("rb") as written:
                        os.fsync(written.fileno())

    def supersede(self) -> None:
        """Retire what earlier runs kept of the sequence: it was replaced, and is not to be replayed any more."""
        with self._explained():
            for path in self.messages_path.parent.glob(f"*{INDEX}"):
                messages = path.with_suffix(MESSAGES)
                if (
                    messages != self.messages_path
                    and messages.is_file()
                    and _sequence_of(path) == self._sequence
                ):
                    retire(messages, "superseded")

    def discard(self) -> None:
        """Remove the files: nothing of the run was kept, so the next one meets these messages again."""
        if self._files is None:
            return
        with self._explained():
            for file in self._files:
                with suppress(OSError):  # a full disk refuses the last bytes of what is removed anyway
                    file.close()
            self.messages_path.unlink(missing_ok=True)
            self.messages_path.with_suffix(INDEX).unlink(missing_ok=True)

    def _create(self) -> tuple[McapFile, TextIO]:
        self.messages_path.parent.mkdir(parents=True, exist_ok=True)
        index = self.messages_path.with_suffix(INDEX).open("x", encoding="utf-8", buffering=1)
        self._files = McapFile(self.messages_path), index
        return self._files

    def _entry(
        self, connection: Connection, batch: MessageBlock, failure: RowFailure, stage: Stage, target: str
    ) -> dict[str, str | int | None]:
        text = connection.definition.text if connection.definition else None
        return {
            "sequence": self._sequence,
            "topic": connection.topic,
            "target": target,
            "msgtype": connection.msgtype,
            "definition": None if text is None else hashlib.sha256(text.encode()).hexdigest()[:16],
            "log_time_ns": int(batch.log_times[failure.row]),
            "offset": int(batch.offsets[failure.row]),
            "bytes": int(batch.lengths[failure.row]),
            "stage": stage.value,
            "rule": failure.rule,
            "reason": failure.reason,
        }

    @contextmanager
    def _explained(self) -> Generator[None, None, None]:
        try:
            yield
        except OSError as error:
            where = str(self.messages_path.parent)
            raise SinkError(f"cannot write the quarantine: {error.strerror}", where=where) from error


def retire(messages: Path, why: str) -> None:
    """Rename messages and their index, so that no replay takes them.

    Raises:
        SinkError: The folder refuses; what was brought in already is recognised by the next replay.
    """
    try:
        for path in (messages, messages.with_suffix(INDEX)):
            path.rename(path.with_name(f"{path.name}.{why}"))
    except OSError as error:
        where = str(error.filename or messages)
        raise SinkError(f"cannot be marked as {why}: {error.strerror}", where=where) from error


def _allows(limit: Limit | None, kept: int, promised: int | None, read: int) -> bool:
    """Say whether one more may be kept; a share is of what is promised, or of what was read where nothing is."""
    if limit is None:
        return True
    if limit.count is not None:
        return kept < limit.count
    return kept < math.ceil((limit.share or 0.0) * (read if promised is None else promised))


def _sequence_of(index: Path) -> str | None:
    try:
        with index.open(encoding="utf-8") as lines:
            return str(json.loads(lines.readline())["sequence"])
    except (ValueError, KeyError, TypeError):
        return None
