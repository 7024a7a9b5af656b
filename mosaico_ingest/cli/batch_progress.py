"""This file draws a batch while it goes: totals, time left, and the few recordings in work."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from rich.console import Console, Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from mosaico_ingest.report.events import (
    Event,
    Noted,
    Rejected,
    RunFinished,
    RunStarted,
    RunStatus,
    TopicProgress,
    Unreadable,
)
from mosaico_ingest.report.units import bytes_text, count_text, seconds_text

__all__ = ["BatchBoard", "BatchLines", "print_nothing"]

LINE_EVERY_S = 5.0
_FAILED = {RunStatus.FAILED, RunStatus.INTERRUPTED}


@dataclass(slots=True)
class _Recording:
    start: RunStarted
    promised: int
    read: int = 0
    rejected: int = 0
    payload_bytes: int = 0


@dataclass(slots=True)
class _Batch:
    """What both displays know of the batch."""

    recordings: int
    began: float = field(default_factory=time.monotonic)
    at_work: dict[int, _Recording] = field(default_factory=dict[int, _Recording])
    done: int = 0
    failed: int = 0
    read: int = 0
    rejected: int = 0
    payload_bytes: int = 0

    def add(self, position: int, event: Event) -> None:
        match event:
            case RunStarted():
                promised = sum(topic.count or 0 for topic in event.topics if not topic.left_out)
                self.at_work[position] = _Recording(event, promised)
            case TopicProgress():
                self.at_work[position].read += event.read
                self.at_work[position].payload_bytes += event.payload_bytes
            case Rejected():
                self.at_work[position].rejected += event.count
            case RunFinished():
                self._finish(self.at_work.pop(position, None), event)
            case _:
                pass

    def _finish(self, recording: _Recording | None, event: RunFinished) -> None:
        self.done += 1
        self.failed += event.status in _FAILED
        if recording is not None:
            self.read += recording.read
            self.rejected += recording.rejected
            self.payload_bytes += recording.payload_bytes

    def share(self) -> float:
        """Return how much of the batch is done, from 0 to 1; recordings count alike, for none has been looked into."""
        parts = (min(one.read / one.promised, 1.0) for one in self.at_work.values() if one.promised)
        return min((self.done + sum(parts)) / self.recordings, 1.0)

    def headline(self) -> str:
        elapsed = max(time.monotonic() - self.began, 1e-9)
        read = self.read + sum(one.read for one in self.at_work.values())
        size = self.payload_bytes + sum(one.payload_bytes for one in self.at_work.values())
        rejected = self.rejected + sum(one.rejected for one in self.at_work.values())
        parts = [f"{self.done} of {self.recordings} recordings"]
        parts += [f"{self.failed} failed"] if self.failed else []
        parts += [f"{count_text(read)} messages"]
        parts += [f"{count_text(rejected)} rejected"] if rejected else []
        parts += [f"{count_text(round(read / elapsed))} msg/s, {bytes_text(size / elapsed)}/s"]
        share = self.share()
        parts += [f"{seconds_text(elapsed / share - elapsed)} left"] if 0 < share < 1 else []
        return ", ".join(parts)


class BatchLines:
    """An observer that prints a line for each recording that ends, and one on the whole every few seconds."""

    def __init__(self, console: Console, recordings: int) -> None:
        self._console = console
        self._batch = _Batch(recordings)
        self._next = time.monotonic() + LINE_EVERY_S

    def __call__(self, position: int, event: Event) -> None:
        """Take one event."""
        recording = self._batch.at_work.get(position)
        self._batch.add(position, event)
        name = recording.start.sequence if recording else f"recording {position + 1}"
        match event:
            case Noted():
                self._print(f"{name}: note: {event.finding}")
            case Unreadable():
                self._print(f"{name}: unreadable: {event.reason}")
            case RunFinished():
                self._print(f"{name}: {_ending(recording, event)}")
            case _:
                pass
        if time.monotonic() >= self._next:
            self._print(self._batch.headline())
            self._next = time.monotonic() + LINE_EVERY_S

    def _print(self, line: str) -> None:
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)


class BatchBoard:
    """An observer that keeps a table of the recordings in work; rich asks it for the picture."""

    def __init__(self, recordings: int) -> None:
        self._batch = _Batch(recordings)
        self.say = print_nothing

    def __call__(self, position: int, event: Event) -> None:
        """Take one event."""
        recording = self._batch.at_work.get(position)
        self._batch.add(position, event)
        name = recording.start.sequence if recording else f"recording {position + 1}"
        match event:
            case Noted():
                self.say(Text(f"{name}: note: {event.finding}", style="yellow"))
            case Unreadable():
                self.say(Text(f"{name}: unreadable: {event.reason}", style="red"))
            case RunFinished() if event.error is not None:
                self.say(Text(f"{name}: {_ending(recording, event)}", style="red"))
            case _:
                pass

    def render(self) -> RenderableType:
        """Return the picture."""
        batch = self._batch
        table = Table(box=None, pad_edge=False, header_style="dim")
        table.add_column("recording", overflow="ellipsis", no_wrap=True)
        for column in ("read", "of", "rejected"):
            table.add_column(column, justify="right")
        for one in tuple(batch.at_work.values()):
            promised = count_text(one.promised) if one.promised else "?"
            table.add_row(one.start.sequence, count_text(one.read), promised, count_text(one.rejected))
        bar = ProgressBar(total=1.0, completed=batch.share(), width=40)
        return Group(table, Text(batch.headline(), style="bold"), bar)


def print_nothing(*_: object) -> None:
    """Stand in until the live display runs."""


def _ending(recording: _Recording | None, event: RunFinished) -> str:
    if event.error is not None:
        return f"{event.status.value}: {event.error}"
    read = recording.read if recording else 0
    rejected = f", {count_text(recording.rejected)} rejected" if recording and recording.rejected else ""
    return f"{event.status.value}, {count_text(read)} messages{rejected}"
