"""This file draws a run while it goes: a live table on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from mosaico_ingest.cli.batch_progress import BatchBoard, BatchLines, print_nothing, unreadable_text
from mosaico_ingest.cli.console import Terminal, plain_table
from mosaico_ingest.cli.tally import Tally
from mosaico_ingest.report.events import (
    BatchObserver,
    Event,
    Expected,
    Noted,
    Observer,
    Rejected,
    RunFinished,
    RunStarted,
    TopicProgress,
    Unreadable,
)
from mosaico_ingest.report.units import bytes_text, count_text, counted

__all__ = ["display"]

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
                self.topics = {t.target: _Count(t) for t in event.topics if not t.left_out}
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
    taken = sum(not topic.left_out for topic in start.topics)
    size = bytes_text(start.source_bytes)
    return f"{start.sequence}: {counted(taken, 'topic')} from {', '.join(start.files)} ({size}) to {start.destination}"
