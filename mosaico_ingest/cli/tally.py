"""This file keeps count of a batch while it goes, for people and for programs: totals, rates, time left, what is in work."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from mosaico_ingest.config import ROSInjectionConfig
from mosaico_ingest.errors import IngestError
from mosaico_ingest.remote.path import AnyPath
from mosaico_ingest.report.events import Event, Rejected, RunFinished, RunStarted, RunStatus, TopicProgress

__all__ = ["Tally", "Underway", "sizes_of"]

_FAILED = {RunStatus.FAILED, RunStatus.INTERRUPTED}
_MOST_LOOKED_AT = 10_000
"""Recordings; the sizes of more are not worth the wait on a slow file system."""
_SURE_S = 3.0
"""Before that, what is left is a guess."""


@dataclass(slots=True)
class Underway:
    """A recording in work."""

    start: RunStarted
    promised: int
    read: int = 0
    rejected: int = 0
    payload_bytes: int = 0

    @property
    def share(self) -> float:
        """How much of it is read, from 0 to 1."""
        return min(self.read / self.promised, 1.0) if self.promised else 0.0


@dataclass(slots=True)
class Tally:
    """What is known of a batch of recordings of these sizes in bytes; events come in, totals are looked at."""

    sizes: Sequence[int]
    began: float = field(default_factory=time.monotonic)
    at_work: dict[int, Underway] = field(default_factory=dict[int, Underway])
    done: int = 0
    failed: int = 0
    _read: int = 0
    _rejected: int = 0
    _payload_bytes: int = 0
    _done_bytes: int = 0
    _unread_bytes: int = 0

    def add(self, position: int, event: Event) -> None:
        """Take one event of the recording at this position."""
        match event:
            case RunStarted():
                promised = sum(topic.count or 0 for topic in event.topics if not topic.left_out)
                self.at_work[position] = Underway(event, promised)
            case TopicProgress():
                self.at_work[position].read += event.read
                self.at_work[position].payload_bytes += event.payload_bytes
            case Rejected():
                self.at_work[position].rejected += event.count
            case RunFinished():
                self._finish(position, event)
            case _:
                pass

    def _finish(self, position: int, event: RunFinished) -> None:
        self.done += 1
        self.failed += event.status in _FAILED
        self._done_bytes += self.sizes[position]
        recording = self.at_work.pop(position, None)
        if recording is None or not recording.read:
            self._unread_bytes += self.sizes[position]
        else:
            self._read += recording.read
            self._rejected += recording.rejected
            self._payload_bytes += recording.payload_bytes

    @property
    def recordings(self) -> int:
        """How many there are in all."""
        return len(self.sizes)

    @property
    def read(self) -> int:
        """Messages read so far."""
        return self._read + sum(one.read for one in self.at_work.values())

    @property
    def rejected(self) -> int:
        """Messages rejected so far."""
        return self._rejected + sum(one.rejected for one in self.at_work.values())

    @property
    def payload_bytes(self) -> int:
        """Bytes of the messages read so far."""
        return self._payload_bytes + sum(one.payload_bytes for one in self.at_work.values())

    @property
    def elapsed_s(self) -> float:
        """Seconds since it began, never 0."""
        return max(time.monotonic() - self.began, 1e-9)

    @property
    def share(self) -> float:
        """How much of the batch is done, from 0 to 1, by size."""
        return min(self._bytes() / max(sum(self.sizes), 1), 1.0)

    @property
    def left_s(self) -> float | None:
        """Seconds to go at the speed so far, None before there is one; what was skipped, or failed at once, says nothing of it."""
        worked = self._bytes() - self._unread_bytes
        left = sum(self.sizes) - self._bytes()
        known = worked > 0 and left > 0 and self.elapsed_s >= _SURE_S
        return self.elapsed_s * left / worked if known else None

    def _bytes(self) -> float:
        parts = (self.sizes[position] * one.share for position, one in self.at_work.items())
        return self._done_bytes + sum(parts)


def sizes_of(configs: Sequence[ROSInjectionConfig]) -> list[int]:
    """Return how large each recording is, in bytes; where that is not known of all, they count alike."""
    sizes: list[int] = []
    if len(configs) <= _MOST_LOOKED_AT:
        with suppress(OSError, IngestError, ValueError):
            sizes.extend(max(1, sum(map(_size, config.paths))) for config in configs)
    return sizes if len(sizes) == len(configs) else [1] * len(configs)


def _size(path: AnyPath) -> int:
    if isinstance(path, Path):
        return sum(_size(part) for part in path.iterdir()) if path.is_dir() else path.stat().st_size
    if path.listed is None:
        raise ValueError("nobody has listed it, and asking for each takes long")
    return path.listed.st_size
