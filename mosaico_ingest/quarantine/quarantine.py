"""This file keeps messages that were rejected: their bytes in an MCAP file, what was wrong with them in a JSONL file."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections import Counter
from collections.abc import Generator
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import TextIO

from mosaico_ingest.bag.batch import RawBatch
from mosaico_ingest.config import Limit, QuarantineSettings
from mosaico_ingest.diagnostics import RowFailure, Stage
from mosaico_ingest.errors import SinkError
from mosaico_ingest.quarantine.mcap_file import McapFile

__all__ = ["INDEX", "MESSAGES", "Quarantine", "kept_name", "retire"]

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
        batch: RawBatch,
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
            messages.write(batch.channel, int(batch.log_times[row]), batch.payload(row))
            index.write(json.dumps(self._entry(batch, failure, stage, target), ensure_ascii=False) + "\n")
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
        self, batch: RawBatch, failure: RowFailure, stage: Stage, target: str
    ) -> dict[str, str | int | None]:
        channel = batch.channel
        text = channel.definition.text if channel.definition else None
        return {
            "sequence": self._sequence,
            "topic": channel.topic,
            "target": target,
            "msgtype": channel.msgtype,
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
