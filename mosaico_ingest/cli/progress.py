"""Progress of a run on standard error: a live table in a terminal, text lines elsewhere, or JSON lines."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from msgspec import Struct, field
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.text import Text

from mosaico_ingest.cli.console import PlainTable, Terminal
from mosaico_ingest.cli.process import json_line
from mosaico_ingest.display import bytes_text, count_text, counted, percent_text, seconds_text
from mosaico_ingest.executors import source_bytes
from mosaico_ingest.findings import one_line
from mosaico_ingest.report.events import (
    BatchObserver,
    Event,
    Expected,
    Noted,
    Rejected,
    RunFinished,
    RunStarted,
    RunStatus,
    TopicProgress,
    Unreadable,
)

if TYPE_CHECKING:
    from mosaico_ingest.job.model import Job

LINE_INTERVAL_S = 5.0
"""Seconds between two lines about the progress of the run."""
MAX_ROWS = 30
"""Topics in the live table; the busiest come first."""
MAX_SIZED_RECORDINGS = 10_000
"""Recordings above which sizes are not determined, because that takes too long on a slow file system."""
MIN_ESTIMATE_S = 3.0
"""Seconds before the remaining time is estimated; earlier estimates are unreliable."""


class TopicTally(Struct):
    """The messages of one topic so far."""

    expected: Expected
    read: int = 0
    written: int = 0
    rejected: int = 0


class RecordingTally(Struct):
    """The messages of one active recording so far."""

    start: RunStarted
    topics: dict[str, TopicTally]
    """By name in the sequence, without excluded topics."""
    payload_bytes: int = 0

    @property
    def counted(self) -> list[TopicTally]:
        """The topics, except topics that share their messages with another topic."""
        return [topic for topic in self.topics.values() if not topic.expected.shares_messages]

    @property
    def promised(self) -> int:
        """Messages that the recording's index promises; 0 if it has no index."""
        return sum(topic.expected.count or 0 for topic in self.counted)

    @property
    def read(self) -> int:
        """Messages read."""
        return sum(topic.read for topic in self.counted)

    @property
    def rejected(self) -> int:
        """Messages rejected."""
        return sum(topic.rejected for topic in self.counted)

    @property
    def share(self) -> float:
        """Share of the messages that is read, from 0 to 1."""
        return min(self.read / self.promised, 1.0) if self.promised else 0.0


class Tally(Struct):
    """Progress of a batch of recordings, summed up from events."""

    sizes: Sequence[int]
    """Bytes of each recording, by position in the batch."""
    started: float = field(default_factory=time.monotonic)
    active: dict[int, RecordingTally] = field(default_factory=dict[int, RecordingTally])
    """Recordings that have started and not finished, by position in the batch."""
    finished: int = 0
    failed: int = 0
    _read: int = 0
    _rejected: int = 0
    _payload_bytes: int = 0
    _finished_bytes: int = 0
    _unread_bytes: int = 0
    """Bytes of recordings that finished without reading: skipped, or failed immediately."""

    def add(self, position: int, event: Event) -> None:
        """Add one event of the recording at this position."""
        match event:
            case RunStarted():
                topics = {topic.target: TopicTally(topic) for topic in event.topics if not topic.excluded}
                self.active[position] = RecordingTally(event, topics)
            case TopicProgress():
                recording = self.active[position]
                recording.topics[event.target].read += event.read
                recording.topics[event.target].written += event.written
                if not recording.topics[event.target].expected.shares_messages:
                    recording.payload_bytes += event.payload_bytes
            case Rejected():
                self.active[position].topics[event.target].rejected += event.count
            case RunFinished():
                self._finish(position, event)
            case _:
                pass

    def _finish(self, position: int, event: RunFinished) -> None:
        self.finished += 1
        self.failed += event.status in {RunStatus.DIVERTED, RunStatus.FAILED, RunStatus.INTERRUPTED}
        self._finished_bytes += self.sizes[position]
        recording = self.active.pop(position, None)
        if recording is None or not recording.read:
            self._unread_bytes += self.sizes[position]
        else:
            self._read += recording.read
            self._rejected += recording.rejected
            self._payload_bytes += recording.payload_bytes

    @property
    def recordings(self) -> int:
        """Number of recordings in the batch."""
        return len(self.sizes)

    @property
    def read(self) -> int:
        """Messages read."""
        return self._read + sum(recording.read for recording in self.active.values())

    @property
    def rejected(self) -> int:
        """Messages rejected."""
        return self._rejected + sum(recording.rejected for recording in self.active.values())

    @property
    def payload_bytes(self) -> int:
        """Bytes of the messages read."""
        return self._payload_bytes + sum(recording.payload_bytes for recording in self.active.values())

    @property
    def elapsed_s(self) -> float:
        """Seconds since the start, never 0."""
        return max(time.monotonic() - self.started, 1e-9)

    @property
    def share(self) -> float:
        """Share of the batch that is read, from 0 to 1, weighted by size."""
        return min(self._read_bytes() / max(sum(self.sizes), 1), 1.0)

    @property
    def remaining_s(self) -> float | None:
        """Estimated seconds until the end, or None if there is no estimate yet.

        Recordings that were skipped or failed immediately do not count toward the speed.
        """
        read_bytes = self._read_bytes() - self._unread_bytes
        remaining_bytes = sum(self.sizes) - self._read_bytes()
        if read_bytes <= 0 or remaining_bytes <= 0 or self.elapsed_s < MIN_ESTIMATE_S:
            return None
        return self.elapsed_s * remaining_bytes / read_bytes

    def _read_bytes(self) -> float:
        return self._finished_bytes + sum(
            self.sizes[position] * recording.share for position, recording in self.active.items()
        )


def recording_sizes(jobs: Sequence[Job]) -> list[int]:
    """Return the size of each recording in bytes, or 1 for each if a size is unknown."""
    sizes: list[int] = []
    if len(jobs) <= MAX_SIZED_RECORDINGS:
        sizes.extend(max(1, size) for size in map(source_bytes, jobs) if size is not None)
    return sizes if len(sizes) == len(jobs) else [1] * len(jobs)


def headline(tally: Tally) -> str:
    """Return one line with the totals, the percentage, the rates, and the elapsed and the remaining time."""
    alone = tally.recordings == 1
    parts: list[str] = []
    if not alone:
        parts += [f"{tally.finished} of {counted(tally.recordings, 'recording')}"]
        parts += [f"{tally.failed} failed"] if tally.failed else []
    if tally.read:
        promised = sum(recording.promised for recording in tally.active.values()) if alone else 0
        share = f"{count_text(tally.read)} of " if promised else ""
        parts += [f"{share}{counted(promised or tally.read, 'message')}"]
        parts += [f"{count_text(tally.rejected)} rejected"] if tally.rejected else []
        parts += [percent_text(tally.share)] if 0 < tally.share < 1 else []
        rate = count_text(round(tally.read / tally.elapsed_s))
        parts += [f"{rate} msg/s, {bytes_text(tally.payload_bytes / tally.elapsed_s)}/s"]
    parts += [f"{seconds_text(tally.elapsed_s)} elapsed"] if tally.read else []
    parts += [f"{seconds_text(tally.remaining_s)} left"] if tally.remaining_s is not None else []
    name = next((f"{recording.start.sequence}: " for recording in tally.active.values()), "")
    return one_line(f"{name if alone else ''}{', '.join(parts)}")


@contextmanager
def live_display(tally: Tally) -> Generator[BatchObserver]:
    """Yield the observer that shows a batch on standard error: live in a terminal, as lines elsewhere."""
    console = Terminal(stderr=True)
    if not console.is_terminal:
        yield TextLines(console, tally)
        return
    table = LiveTable(tally)
    with Live(get_renderable=table.render, console=console, refresh_per_second=8, transient=True) as live:
        table.print = live.console.print
        yield table


class TextLines:
    """An observer that prints a line when something happens, and the progress every few seconds."""

    def __init__(self, console: Console, tally: Tally) -> None:
        self._console = console
        self._tally = tally
        self._next = time.monotonic() + LINE_INTERVAL_S

    def __call__(self, position: int, event: Event) -> None:
        """Add one event."""
        recording = self._tally.active.get(position)
        self._tally.add(position, event)
        alone = self._tally.recordings == 1
        match event:
            case RunStarted() if alone and event.topics:
                self._print(_start_text(event))
            case RunFinished() if not alone:
                self._print(f"{_prefix(self._tally, position, recording)}{_finish_text(recording, event)}")
            case Noted() | Unreadable():
                self._print(f"{_prefix(self._tally, position, recording)}{_event_text(event)}")
            case _:
                pass
        if time.monotonic() >= self._next and not (alone and isinstance(event, RunFinished)):
            self._print(headline(self._tally))
            self._next = time.monotonic() + LINE_INTERVAL_S

    def _print(self, line: str) -> None:
        self._console.print(one_line(line), markup=False, highlight=False, soft_wrap=True)


class LiveTable:
    """An observer that renders a table: of the topics of a single recording, or of the active recordings."""

    def __init__(self, tally: Tally) -> None:
        self._tally = tally
        self.print: Callable[[Text], None] = lambda _line: None
        """Prints a line above the table, once the display runs."""

    def __call__(self, position: int, event: Event) -> None:
        """Add one event."""
        recording = self._tally.active.get(position)
        self._tally.add(position, event)
        prefix = _prefix(self._tally, position, recording)
        match event:
            case Noted():
                self._print(f"{prefix}{_event_text(event)}", "yellow")
            case Unreadable():
                self._print(f"{prefix}{_event_text(event)}", "red")
            case RunFinished() if event.error is not None and self._tally.recordings > 1:
                self._print(f"{prefix}{_finish_text(recording, event)}", "red")
            case _:
                pass

    def _print(self, line: str, style: str) -> None:
        self.print(Text(one_line(line), style=style))

    def render(self) -> RenderableType:
        """Return the table, the totals and a progress bar; nothing once a single recording has finished."""
        tally = self._tally
        active = tuple(tally.active.values())
        alone = tally.recordings == 1
        if alone and not active:
            return Text("")
        tables = [_topic_table(active[0]) if alone else _recording_table(active)] if active else []
        bar = ProgressBar(total=1.0, completed=tally.share, width=40)
        return Group(*tables, Text(headline(tally), style="bold"), bar)


class JsonLines:
    """An observer that writes JSON lines: started, progress, note, unreadable and finished."""

    def __init__(self, tally: Tally) -> None:
        self._tally = tally
        self._next = time.monotonic() + LINE_INTERVAL_S

    def __call__(self, position: int, event: Event) -> None:
        """Add one event."""
        previous = self._tally.active.get(position)
        self._tally.add(position, event)
        recording = self._tally.active.get(position, previous)
        match event:
            case RunStarted():
                values = {"files": event.files, "source_bytes": event.source_bytes}
                self._write(position, recording, "started", values)
            case TopicProgress() if recording is not None and time.monotonic() >= self._next:
                self._next = time.monotonic() + LINE_INTERVAL_S
                self._write(
                    position, recording, "progress", {"read": recording.read, "batch": self._totals()}
                )
            case Noted():
                self._write(position, recording, "note", {"message": str(event.finding)})
            case Unreadable():
                values = {"topic": event.target, "count": event.count, "message": event.reason}
                self._write(position, recording, "unreadable", values)
            case RunFinished():
                counts = {
                    "read": recording.read if recording else 0,
                    "rejected": recording.rejected if recording else 0,
                }
                values = {"status": event.status.value, "error": event.error, **counts}
                self._write(position, recording, "finished", values)
            case _:
                pass

    def _totals(self) -> dict[str, Any]:
        """Return the progress of the batch; `remaining_s` is null without an estimate."""
        tally = self._tally
        return {
            "recordings": tally.recordings,
            "finished": tally.finished,
            "failed": tally.failed,
            "active": [recording.start.sequence for recording in tally.active.values()],
            "read": tally.read,
            "rejected": tally.rejected,
            "payload_bytes": tally.payload_bytes,
            "elapsed_s": round(tally.elapsed_s, 3),
            "remaining_s": None if tally.remaining_s is None else round(tally.remaining_s, 3),
        }

    def _write(
        self, position: int, recording: RecordingTally | None, event: str, values: dict[str, Any]
    ) -> None:
        sequence = recording.start.sequence if recording else None
        sys.stderr.write(json_line(event, recording=position, sequence=sequence, **values) + "\n")


def _topic_table(recording: RecordingTally) -> PlainTable:
    names = ("topic", "ontology", "read", "written", "rejected")
    table = PlainTable(*names, numbers={"read", "written", "rejected"}, ellipsis=True)
    topics = sorted(recording.topics.values(), key=lambda topic: -topic.read)
    for topic in topics[:MAX_ROWS]:
        table.add_row(
            topic.expected.target,
            topic.expected.ontology,
            count_text(topic.read),
            count_text(topic.written),
            Text(count_text(topic.rejected), style="red" if topic.rejected else "dim"),
        )
    if len(topics) > MAX_ROWS:
        table.add_row(f"… and {len(topics) - MAX_ROWS} more", "", "", "", "")
    return table


def _recording_table(recordings: Sequence[RecordingTally]) -> PlainTable:
    names = ("recording", "read", "of", "rejected")
    table = PlainTable(*names, numbers={"read", "of", "rejected"}, ellipsis=True)
    for recording in recordings:
        promised = count_text(recording.promised) if recording.promised else "?"
        rejected = count_text(recording.rejected)
        table.add_row(recording.start.sequence, count_text(recording.read), promised, rejected)
    return table


def _prefix(tally: Tally, position: int, recording: RecordingTally | None) -> str:
    """Return the name of a recording for lines about a batch, and nothing for a single recording."""
    if tally.recordings == 1:
        return ""
    return f"{recording.start.sequence}: " if recording else f"recording {position + 1}: "


def _start_text(start: RunStarted) -> str:
    selected = sum(not topic.excluded for topic in start.topics)
    source = f"{', '.join(start.files)} ({bytes_text(start.source_bytes)})"
    return f"{start.sequence}: {counted(selected, 'topic')} from {source} to {start.destination}"


def _event_text(event: Noted | Unreadable) -> str:
    """Return the text of a finding, or the count, topic, offset and reason of an unreadable range."""
    if isinstance(event, Noted):
        return f"note: {event.finding}"
    count = counted(event.count, "message") if event.count else ""
    topic = f"of {event.target}" if count and event.target else event.target or ""
    offset = "" if event.offset is None else f"at {event.offset}"
    location = " ".join(part for part in (count, topic, offset) if part)
    return f"unreadable: {location}: {event.reason}" if location else f"unreadable: {event.reason}"


def _finish_text(recording: RecordingTally | None, event: RunFinished) -> str:
    if event.error is not None:
        return f"{event.status.value}: {event.error}"
    if event.status is RunStatus.SKIPPED:
        return event.status.value
    read = recording.read if recording else 0
    rejected = f", {count_text(recording.rejected)} rejected" if recording and recording.rejected else ""
    return f"{event.status.value}, {counted(read, 'message')}{rejected}"
