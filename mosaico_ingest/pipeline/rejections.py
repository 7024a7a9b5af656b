"""Rejected messages: their bytes in a quarantine file, their reasons in a JSONL file beside it, and warnings in the log."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import time
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import TextIO

from msgspec import Struct, field

from mosaico_ingest.display import counted, time_text
from mosaico_ingest.errors import BagError, NothingMatched, SinkError
from mosaico_ingest.findings import RowFailure, Stage
from mosaico_ingest.job.model import QuarantineSettings
from mosaico_ingest.job.values import Limit
from mosaico_ingest.report.events import Event, Rejected, RunFinished
from mosaico_ingest.rosbag.blocks import Connection, MessageBlock
from mosaico_ingest.rosbag.definitions.model import Source
from mosaico_ingest.rosbag.mcap.writer import McapWriter

MESSAGES = ".mcap"
INDEX = ".jsonl"
_QOS = "offered_qos_profiles"
WARNING_INTERVAL_S = 10.0
"""Least seconds between two warnings about one topic and rule."""
_log = logging.getLogger("mosaico_ingest.pipeline")


def quarantine_file_name(sequence: str) -> str:
    """Return a name for the quarantine file of a run that starts now."""
    stamp = datetime.now(timezone.utc).strftime("%Y%m%dT%H%M%S%fZ")
    return f"{sequence}-{stamp}{MESSAGES}"


class QuarantineFile(Struct, frozen=True):
    """The quarantined messages of one run, and the sequence they belong to."""

    messages: Path
    sequence: str

    def mark_replayed(self) -> None:
        """Rename the file, so that the next replay ignores it."""
        retire(self.messages, "replayed")


def find_quarantine_files(folder: Path) -> tuple[QuarantineFile, ...]:
    """Return the files of a quarantine folder, for each sequence the oldest first.

    Raises:
        NothingMatched: The folder has no quarantine file.
        BagError: An index does not exist or cannot be read.
    """
    files = tuple(_quarantine_files(folder))
    if not files:
        raise NothingMatched(
            "there is nothing to replay", where=str(folder), hint="name the folder of a quarantine"
        )
    return files


def _quarantine_files(folder: Path) -> Iterator[QuarantineFile]:
    for messages in sorted(folder.glob(f"*{MESSAGES}")):
        index = messages.with_suffix(INDEX)
        try:
            with index.open(encoding="utf-8") as lines:
                first = lines.readline()
            if first.endswith("\n"):  # otherwise the run was killed before it kept a message
                yield QuarantineFile(messages, str(json.loads(first)["sequence"]))
        except (OSError, ValueError, KeyError, TypeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise BagError(f"this is not the index of a quarantine: {reason}", where=str(index)) from error


def retire(messages: Path, suffix: str) -> None:
    """Append a suffix to the names of a quarantine file and its index, so that no replay reads them.

    Raises:
        SinkError: The files cannot be renamed; the next replay recognizes messages that are stored already.
    """
    try:
        for path in (messages, messages.with_suffix(INDEX)):
            path.rename(path.with_name(f"{path.name}.{suffix}"))
    except OSError as error:
        where = str(error.filename or messages)
        raise SinkError(f"cannot be marked as {suffix}: {error.strerror}", where=where) from error


class Quarantine:
    """The rejected messages of one run; its two files are created with the first message."""

    def __init__(
        self, settings: QuarantineSettings, sequence: str, promised: int | None, *, name: str | None = None
    ) -> None:
        """Prepare a quarantine; `promised` is the number of messages in the index, None if it is unknown."""
        self.systematic = settings.systematic
        self.messages_path = Path(settings.path) / (name or quarantine_file_name(sequence))
        self.count = 0
        """Number of quarantined messages."""
        self._settings = settings
        self._sequence = sequence
        self._promised = promised
        self._count_by_topic: Counter[str] = Counter()
        self._files: tuple[McapWriter, TextIO] | None = None
        self._connections: dict[int, int] = {}

    def add(
        self,
        connection: Connection,
        block: MessageBlock,
        failure: RowFailure,
        *,
        stage: Stage,
        target: str,
        promised: int | None,
        read: int,
    ) -> bool:
        """Store one message of a block unless a limit is reached; return whether it was stored.

        `promised` and `read` are the numbers of messages of the topic in the index and read so far.

        Raises:
            SinkError: The files cannot be written.
        """
        topic_limit, run_limit = self._settings.max, self._settings.max_run
        if not _allows(topic_limit, self._count_by_topic[target], promised, read):
            return False
        if not _allows(run_limit, self.count, self._promised, read):
            return False
        with self._explained():
            messages, index = self._files or self._create()
            row = failure.row
            messages.write(
                self._connection(messages, connection), int(block.log_times[row]), block.payload(row)
            )
            index.write(
                json.dumps(self._entry(connection, block, failure, stage, target), ensure_ascii=False) + "\n"
            )
        self._count_by_topic[target] += 1
        self.count += 1
        return True

    def close(self) -> None:
        """Finish the files and flush them to disk: the provenance record that is committed next names them."""
        with self._explained():
            if self._files is not None:
                messages, index = self._files
                messages.finish()
                index.close()
                for path in (self.messages_path, self.messages_path.with_suffix(INDEX)):
                    with path.open("rb+") as file:
                        os.fsync(file.fileno())

    def supersede(self) -> None:
        """Retire the files of earlier runs: their sequence was replaced, so they must not be replayed."""
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
        """Remove the files: the session was discarded, so the next run meets these messages again."""
        if self._files is None:
            return
        messages, index = self._files
        with self._explained():
            for close in (messages.abandon, index.close):
                with suppress(OSError):  # a full disk refuses the last bytes of a file that is removed anyway
                    close()
            self.messages_path.unlink(missing_ok=True)
            self.messages_path.with_suffix(INDEX).unlink(missing_ok=True)

    def _create(self) -> tuple[McapWriter, TextIO]:
        self.messages_path.parent.mkdir(parents=True, exist_ok=True)
        index = self.messages_path.with_suffix(INDEX).open("x", encoding="utf-8", buffering=1)
        self._files = McapWriter(self.messages_path), index
        return self._files

    def _connection(self, messages: McapWriter, connection: Connection) -> int:
        """Return the connection of the file for one of the recording.

        Only a definition from the recording is embedded. A definition from elsewhere may be the reason why the message
        was rejected, so a replay looks it up again.
        """
        if connection.id not in self._connections:
            if connection.definition is None:
                raise BagError("no definition of the type is known", where=connection.topic)
            self._connections[connection.id] = messages.add_connection(
                connection.topic,
                connection.definition,
                embed=connection.definition.source is Source.BAG,
                metadata={key: value for key, value in connection.attributes.items() if key == _QOS},
            )
        return self._connections[connection.id]

    def _entry(
        self, connection: Connection, block: MessageBlock, failure: RowFailure, stage: Stage, target: str
    ) -> dict[str, str | int | None]:
        text = connection.definition.text if connection.definition else None
        return {
            "sequence": self._sequence,
            "topic": connection.topic,
            "target": target,
            "msgtype": connection.msgtype,
            "definition": None if text is None else hashlib.sha256(text.encode()).hexdigest()[:16],
            "log_time_ns": int(block.log_times[failure.row]),
            "offset": int(block.offsets[failure.row]),
            "bytes": int(block.lengths[failure.row]),
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


def _allows(limit: Limit | None, count: int, promised: int | None, read: int) -> bool:
    """Return whether a limit allows one more message.

    A share refers to the number of promised messages, or to the number of messages read if the index has no number.
    """
    if limit is None:
        return True
    if limit.count is not None:
        return count < limit.count
    return count < math.ceil((limit.share or 0.0) * (read if promised is None else promised))


def _sequence_of(index: Path) -> str | None:
    try:
        with index.open(encoding="utf-8") as lines:
            return str(json.loads(lines.readline())["sequence"])
    except (ValueError, KeyError, TypeError):
        return None


class _Pending(Struct):
    """Messages of one topic that broke one rule and have not been logged."""

    first: Rejected
    count: int
    next_at: float
    """Monotonic time from which the messages may be logged."""


class RejectionLog(Struct):
    """An observer that logs undecodable messages: the first of each topic and rule immediately, the others in groups."""

    sequence: str
    _pending: dict[tuple[str, str], _Pending] = field(default_factory=dict[tuple[str, str], _Pending])

    def __call__(self, event: Event) -> None:
        """Log or collect an event; the end of the run logs all pending events."""
        if isinstance(event, RunFinished):
            for pending in self._pending.values():
                self._flush(pending)
        elif isinstance(event, Rejected) and event.stage is Stage.DECODE:
            self._add(event)

    def _add(self, event: Rejected) -> None:
        key = (event.target, event.rule)
        pending = self._pending.get(key)
        now = time.monotonic()
        if pending is None:
            self._warn(event, event.count, "")
            self._pending[key] = _Pending(event, 0, now + WARNING_INTERVAL_S)
            return
        if not pending.count:
            pending.first = event
        pending.count += event.count
        if now >= pending.next_at:
            self._flush(pending)
            pending.next_at = now + WARNING_INTERVAL_S

    def _flush(self, pending: _Pending) -> None:
        if pending.count:
            self._warn(pending.first, pending.count, "more ")
            pending.count = 0

    def _warn(self, first: Rejected, count: int, more: str) -> None:
        _log.warning(
            "%s: %s cannot be decoded [%s]: %s (topic %s, first log time %s, offset %d)",
            self.sequence,
            counted(count, f"{more}message"),
            first.rule,
            first.reason,
            first.target,
            time_text(first.first_log_time_ns),
            first.first_offset,
        )
