"""Progress of a run: a live table in a terminal, occasional lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from mosaico_ingest.cli.console import Terminal, plain_table
from mosaico_ingest.errors import IngestError
from mosaico_ingest.report.events import (
    BatchObserver,
    Event,
    Expected,
    Noted,
    Observer,
    Rejected,
    RunFinished,
    RunStarted,
    RunStatus,
    TopicProgress,
    Unreadable,
)
from mosaico_ingest.report.units import (
    bytes_text,
    count_text,
    counted,
    seconds_text,
)

if TYPE_CHECKING:
    from mosaico_ingest.job.config import ROSInjectionConfig
    from mosaico_ingest.remote import AnyPath

__all__ = [
    "BatchBoard",
    "BatchLines",
    "Tally",
    "Underway",
    "display",
    "print_nothing",
    "sizes_of",
    "unreadable_text",
]

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
                promised = sum(topic.count or 0 for topic in event.topics if not topic.excluded)
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


LINE_EVERY_S = 5.0


class BatchLines:
    """An observer that prints a line for each recording that ends, and one on the whole every few seconds."""

    def __init__(self, console: Console, tally: Tally) -> None:
        self._console = console
        self._batch = tally
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
                self._print(f"{name}: {unreadable_text(event)}")
            case RunFinished():
                self._print(f"{name}: {_ending(recording, event)}")
            case _:
                pass
        if time.monotonic() >= self._next:
            self._print(headline(self._batch))
            self._next = time.monotonic() + LINE_EVERY_S

    def _print(self, line: str) -> None:
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)


class BatchBoard:
    """An observer that keeps a table of the recordings in work; rich asks it for the picture."""

    def __init__(self, tally: Tally) -> None:
        self._batch = tally
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
                self.say(Text(f"{name}: {unreadable_text(event)}", style="red"))
            case RunFinished() if event.error is not None:
                self.say(Text(f"{name}: {_ending(recording, event)}", style="red"))
            case _:
                pass

    def render(self) -> RenderableType:
        """Return the picture."""
        batch = self._batch
        table = plain_table()
        table.add_column("recording", overflow="ellipsis")
        for column in ("read", "of", "rejected"):
            table.add_column(column, justify="right", no_wrap=True)
        for one in tuple(batch.at_work.values()):
            promised = count_text(one.promised) if one.promised else "?"
            table.add_row(one.start.sequence, count_text(one.read), promised, count_text(one.rejected))
        bar = ProgressBar(total=1.0, completed=batch.share, width=40)
        rows: list[RenderableType] = [table] if batch.at_work else []
        return Group(*rows, Text(headline(batch), style="bold"), bar)


def headline(batch: Tally) -> str:
    """Return the totals, the rates and the time left as a line."""
    parts = [f"{batch.done} of {batch.recordings} recordings"]
    parts += [f"{batch.failed} failed"] if batch.failed else []
    if batch.read:
        parts += [counted(batch.read, "message")]
        parts += [f"{count_text(batch.rejected)} rejected"] if batch.rejected else []
        rate = count_text(round(batch.read / batch.elapsed_s))
        parts += [f"{rate} msg/s, {bytes_text(batch.payload_bytes / batch.elapsed_s)}/s"]
    parts += [f"{seconds_text(batch.left_s)} left"] if batch.left_s is not None else []
    return ", ".join(parts)


def print_nothing(*_: object) -> None:
    """Stand in until the live display runs."""


def _ending(recording: Underway | None, event: RunFinished) -> str:
    if event.error is not None:
        return f"{event.status.value}: {event.error}"
    if event.status is RunStatus.SKIPPED:
        return event.status.value
    read = recording.read if recording else 0
    rejected = f", {count_text(recording.rejected)} rejected" if recording and recording.rejected else ""
    return f"{event.status.value}, {counted(read, 'message')}{rejected}"


def unreadable_text(event: Unreadable) -> str:
    """Return what could not be read, as far as that can be told: how much, of which topic, where, and why."""
    what = counted(event.count, "message") if event.count else ""
    of = f"of {event.target}" if what and event.target else event.target or ""
    at = "" if event.offset is None else f"at {event.offset}"
    place = " ".join(part for part in (what, of, at) if part)
    return f"unreadable: {place}: {event.reason}" if place else f"unreadable: {event.reason}"


PLAIN_EVERY_S = 5.0
MAX_ROWS = 30
"""Topics shown at once; the busiest come first."""


@contextmanager
def display(tally: Tally) -> Generator[BatchObserver]:
    """Yield the observer that draws one recording or a batch of them, on standard error."""
    console = Terminal(stderr=True)
    if not console.is_terminal:
        lines = BatchLines(console, tally) if tally.recordings > 1 else _Lines(console)
        yield lines if isinstance(lines, BatchLines) else _alone(lines)
        return
    board = BatchBoard(tally) if tally.recordings > 1 else _Board()
    with Live(get_renderable=board.render, console=console, refresh_per_second=8, transient=True) as live:
        board.say = live.console.print
        yield board if isinstance(board, BatchBoard) else _alone(board)


def _alone(observe: Observer) -> BatchObserver:
    """Return the observer of a batch of one."""

    def tell(_position: int, event: Event) -> None:
        observe(event)

    return tell


@dataclass(slots=True)
class _Count:
    expected: Expected
    read: int = 0
    written: int = 0
    rejected: int = 0


@dataclass(slots=True)
class _Tally:
    """What both displays know of the recording in work."""

    start: RunStarted | None = None
    began: float = 0.0
    topics: dict[str, _Count] = field(default_factory=dict[str, _Count])
    payload_bytes: int = 0

    def add(self, event: Event) -> None:
        match event:
            case RunStarted():
                self.start, self.began, self.payload_bytes = event, time.monotonic(), 0
                self.topics = {t.target: _Count(t) for t in event.topics if not t.excluded}
            case TopicProgress():
                count = self.topics[event.target]
                count.read += event.read
                count.written += event.written
                self.payload_bytes += event.payload_bytes
            case Rejected():
                self.topics[event.target].rejected += event.count
            case _:
                pass

    @property
    def elapsed_s(self) -> float:
        return max(time.monotonic() - self.began, 1e-9)

    def sums(self) -> tuple[int, int, int, int]:
        """Return messages read, written, rejected and promised."""
        counts = self.topics.values()
        return (
            sum(c.read for c in counts),
            sum(c.written for c in counts),
            sum(c.rejected for c in counts),
            sum(c.expected.count or 0 for c in counts),
        )

    def headline(self) -> str:
        read, _, rejected, promised = self.sums()
        share = f" of {count_text(promised)}" if promised else ""
        lost = f", {count_text(rejected)} rejected" if rejected else ""
        rate = f"{count_text(round(read / self.elapsed_s))} msg/s, {bytes_text(self.payload_bytes / self.elapsed_s)}/s"
        name = self.start.sequence if self.start else ""
        return f"{name}: {count_text(read)}{share} messages{lost} ({rate})"


class _Lines:
    """An observer that prints a line when a recording begins, and every few seconds while it goes on."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._tally = _Tally()
        self._next = 0.0

    def __call__(self, event: Event) -> None:
        self._tally.add(event)
        now = time.monotonic()
        match event:
            case RunStarted() if event.topics:
                self._print(_begins(event))
                self._next = now + PLAIN_EVERY_S
            case Noted():
                self._print(f"note: {event.finding}")
            case Unreadable():
                self._print(unreadable_text(event))
            case TopicProgress() if now >= self._next:
                self._print(self._tally.headline())
                self._next = now + PLAIN_EVERY_S
            case _:
                pass

    def _print(self, line: str) -> None:
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)


class _Board:
    """An observer that keeps a table of topics; rich asks it for the picture."""

    def __init__(self) -> None:
        self._tally = _Tally()
        self._done = False
        self.say = print_nothing

    def __call__(self, event: Event) -> None:
        self._tally.add(event)
        match event:
            case RunStarted():
                self._done = False
            case RunFinished():
                self._done = True
            case Noted():
                self.say(Text(f"note: {event.finding}", style="yellow"))
            case Unreadable():
                self.say(Text(unreadable_text(event), style="red"))
            case _:
                pass

    def render(self) -> RenderableType:
        if self._tally.start is None or self._done:
            return Text("")
        read, _, _, promised = self._tally.sums()
        bar = ProgressBar(total=max(promised, 1), completed=min(read, promised), width=40)
        return Group(self._table(), Text(self._tally.headline(), style="bold"), bar)

    def _table(self) -> Table:
        table = plain_table()
        table.add_column("topic", overflow="ellipsis")
        table.add_column("ontology", style="cyan", overflow="ellipsis")
        for column in ("read", "written", "rejected"):
            table.add_column(column, justify="right", no_wrap=True)
        counts = sorted(self._tally.topics.values(), key=lambda count: -count.read)
        for count in counts[:MAX_ROWS]:
            rejected = Text(count_text(count.rejected), style="red" if count.rejected else "dim")
            table.add_row(
                count.expected.target,
                count.expected.ontology,
                count_text(count.read),
                count_text(count.written),
                rejected,
            )
        if len(counts) > MAX_ROWS:
            table.add_row(f"… and {len(counts) - MAX_ROWS} more", "", "", "", "")
        return table


def _begins(start: RunStarted) -> str:
    taken = sum(not topic.excluded for topic in start.topics)
    size = bytes_text(start.source_bytes)
    return f"{start.sequence}: {counted(taken, 'topic')} from {', '.join(start.files)} ({size}) to {start.destination}"
