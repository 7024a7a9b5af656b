"""This file draws a batch while it goes: totals, time left, and the few recordings in work."""

from __future__ import annotations

import time

from rich.console import Console, Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.text import Text

from mosaico_ingest.cli.console import plain_table
from mosaico_ingest.cli.tally import Tally, Underway
from mosaico_ingest.report.events import Event, Noted, RunFinished, RunStatus, Unreadable
from mosaico_ingest.report.units import bytes_text, count_text, counted, seconds_text

__all__ = ["BatchBoard", "BatchLines", "print_nothing", "unreadable_text"]

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
