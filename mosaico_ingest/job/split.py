"""The section `split`, the files of events that it reads, and the part of a recording that a job ingests."""

from __future__ import annotations

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from msgspec import Struct
from pydantic import AfterValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from mosaico_ingest.documents import read_limited
from mosaico_ingest.errors import SinkError
from mosaico_ingest.findings import Finding, Severity, Span
from mosaico_ingest.job.expect import Duration
from mosaico_ingest.job.fields import FilePath, PathRole, Section, Text
from mosaico_ingest.job.values import TimeBound, format_time, parse_time
from mosaico_ingest.protocol import check_sequence_name

SPLIT_KEY = "_split_"
"""Key of sequence metadata: the recording's name, the number, times and event of the part."""
PLACEHOLDERS = ("sequence", "part", "event")
"""The placeholders of `split.name`."""
_PLACEHOLDER = re.compile(r"\{([^{}]*)\}")
_REFUSED = re.compile(r"[^A-Za-z0-9_-]+")
_WIDTH = re.compile(r"part:0?[0-9]d?")
_NUMBER = re.compile(r"-?(0|[1-9][0-9]*)(\.[0-9]+)?")
_EPOCH_NUMBER = re.compile(r"([0-9]{1,11})(?:\.([0-9]{1,9}))?")
_EPOCH_NS = re.compile(r"[0-9]{18,19}")
_REFUSED_KEY = re.compile(r"[^A-Za-z0-9 _-]+|-(?=-)")
_OWN_COLUMNS = ("name", "start", "end")


def _check_name(template: str) -> str:
    names = _PLACEHOLDER.findall(template)
    unknown = [name for name in names if name not in PLACEHOLDERS and not _WIDTH.fullmatch(name)]
    if unknown:
        raise ValueError(
            f"unknown placeholder {{{unknown[0]}}}; the placeholders are {{sequence}}, {{part}}, {{part:03}} and {{event}}"
        )
    if not any(name.startswith(("part", "event")) for name in names):
        raise ValueError("all parts would have the same name; add {part} or {event}")
    try:
        check_sequence_name(_PLACEHOLDER.sub("x", template))
    except SinkError as error:
        raise ValueError(error.what) from error
    return template


def _check_positive(length_ns: int) -> int:
    if length_ns <= 0:
        raise ValueError("the length of a part must be longer than 0 s")
    return length_ns


class SplitSettings(Section):
    """One recording becomes several sequences: parts of equal length, or the intervals of a file."""

    by: Annotated[Duration, AfterValidator(_check_positive)] | None = Field(default=None, examples=["10 min"])
    """The length of each part. The first part starts at `bag.time.start`, or else at the start of the recording."""
    events: Annotated[Text, FilePath(PathRole.INPUT)] | None = Field(default=None, examples=["events.csv"])
    """A CSV file with the columns `start` and `end`, and optionally `name`; its other columns become metadata of the part."""
    name: Annotated[Text, AfterValidator(_check_name)] | None = Field(
        default=None, examples=["{sequence}_{part:03}", "{event}"]
    )
    """The name of each part's sequence: {sequence} is `sequence.name`, {part} the number of the part from 1 and {part:03}
    the padded number, {event} the name of the event. Defaults to {sequence}_{part:03}, with `events` to
    {sequence}_{event}."""

    @model_validator(mode="after")
    def _check_one_rule(self) -> SplitSettings:
        if (self.by is None) == (self.events is None):
            key = "events" if self.by is not None else "by"
            message = "write either by or events" if self.by is None else "by and events exclude each other"
            raise PydanticCustomError("conflicting-keys", "{message}", {"key": key, "message": message})
        return self

    def sequence_name(self, sequence: str, number: int, event: str) -> str:
        """Return the name of a part's sequence; `event` is a text that the platform accepts."""
        default = "{sequence}_{part:03}" if self.events is None else "{sequence}_{event}"

        def fill(match: re.Match[str]) -> str:
            name, _, width = match[1].partition(":")
            return f"{number:{width}}" if name == "part" else {"sequence": sequence, "event": event}[name]

        return _PLACEHOLDER.sub(fill, self.name or default)


def clean_name(text: str) -> str:
    """Return a text with `_` in place of characters that `{event}` cannot contain."""
    return _REFUSED.sub("_", text).strip("_")


class SequencePart(Struct, frozen=True):
    """The part of a recording that becomes one sequence: messages with start_ns <= selected time < end_ns."""

    recording: str
    """The name of the sequence that the complete recording would become."""
    number: int
    """The position of the part, from 1."""
    start_ns: int
    end_ns: int
    event: str | None = None
    """The name of the event, as written in the file."""
    read_from_ns: int | None = None
    """Start of the log times of the part's messages, inclusive; None if the log times are not known."""
    read_until_ns: int | None = None
    """End of the log times of the part's messages, exclusive; None if the log times are not known."""
    findings: tuple[Finding, ...] = ()
    """Findings about the split, which one of the parts reports."""

    @property
    def metadata(self) -> dict[str, object]:
        """The metadata that describes the part."""
        event = {} if self.event is None else {"event": self.event}
        return {
            "recording": self.recording,
            "part": self.number,
            **event,
            "start_ns": self.start_ns,
            "end_ns": self.end_ns,
        }


class Event(Struct, frozen=True):
    """One interval of an event file."""

    number: int
    """The position in the file, from 1."""
    name: str
    start: TimeBound
    end: TimeBound
    """The end, exclusive."""
    metadata: Mapping[str, Any]
    """The values of the other columns; numbers, `true` and `false` have the types of JSON, empty cells are absent."""
    span: Span
    """The location of the row."""


class EventFile(Struct, frozen=True):
    """The usable events of a file, and findings about the file."""

    events: tuple[Event, ...]
    findings: tuple[Finding, ...]


def read_events(path: Path) -> EventFile:
    """Read an event file; mistakes become findings."""
    file = str(path)
    start = Span(file, 1, 1, 1, 1)
    try:
        text = read_limited(path).decode("utf-8-sig")
    except OSError as error:
        return _unusable(f"{path} cannot be read: {(error.strerror or str(error)).lower()}", start)
    except UnicodeDecodeError:
        return _unusable(f"{path} is not encoded in UTF-8", start)
    try:
        rows = list(_rows(text))
    except csv.Error as error:
        return _unusable(f"{path} is not CSV: {error}", start)
    if not rows:
        return _unusable(f"{path} is empty", start)
    header = _Row(rows[0].line, [column.strip() for column in rows[0].cells])
    findings = tuple(_header_findings(header, file))
    if findings:
        return EventFile((), findings)
    return _events(header, rows[1:], file)


def overlaps(intervals: Sequence[tuple[int, int, Event]]) -> Iterator[Finding]:
    """Yield a finding for each event that starts before an earlier one has ended; intervals are in nanoseconds."""
    latest: tuple[int, Event] | None = None
    for start_ns, end_ns, event in sorted(intervals, key=lambda interval: interval[:2]):
        if latest is not None and start_ns < latest[0]:
            yield Finding(
                "event-overlap",
                Severity.WARNING,
                f"{event.name!r} starts before {latest[1].name!r} has ended",
                event.span,
                "correct the times if no message may be in both sequences",
            )
        if latest is None or end_ns > latest[0]:
            latest = end_ns, event


class _Row(Struct, frozen=True):
    line: int
    cells: list[str]


def _rows(text: str) -> Iterator[_Row]:
    """Yield the rows that are not blank, with the line on which each starts."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True, skipinitialspace=True)
    line = 1
    for cells in reader:
        if any(cell.strip() for cell in cells):
            yield _Row(line, cells)
        line = reader.line_num + 1


def _events(header: _Row, rows: Sequence[_Row], file: str) -> EventFile:
    events: list[Event] = []
    findings: list[Finding] = []
    for number, row in enumerate(rows, 1):
        result = _event(number, header.cells, row, file)
        if isinstance(result, Finding):
            findings.append(result)
        elif (problem := _interval_problem(result)) is not None:
            findings.append(problem)
        else:
            events.append(result)
    counts = Counter(event.name for event in events)
    names: set[str] = set()
    for event in events:
        if counts[event.name] > 1 and event.name in names:
            findings.append(
                _finding(f"two events have the name {event.name!r}", event.span, "name each event once")
            )
        names.add(event.name)
    if not rows:
        findings.append(
            _finding(f"{file} has no events", Span(file, 1, 1, 1, 1), "add a row for each sequence")
        )
    return EventFile(tuple(events), tuple(findings))


def _event(number: int, columns: Sequence[str], row: _Row, file: str) -> Event | Finding:
    span = Span(file, row.line, 1, row.line + 1, 1)
    if len(row.cells) != len(columns):
        message = f"the row has {len(row.cells)} cells, and the header {len(columns)}"
        return _finding(message, span, "quote cells that contain a comma")
    cells = {column: cell.strip() for column, cell in zip(columns, row.cells, strict=True)}
    start, end = _time(cells["start"]), _time(cells["end"])
    if start is None or end is None:
        column = "start" if start is None else "end"
        message = f"{column} is {cells[column]!r}, which is not a time"
        hint = "write an instant (2026-03-01T12:00:00Z), an offset (+10s, -5min), or seconds since 1970"
        return _finding(message, span, hint)
    metadata = {
        _REFUSED_KEY.sub("_", column): _value(cell)
        for column, cell in cells.items()
        if column not in _OWN_COLUMNS and cell
    }
    return Event(number, cells.get("name") or str(number), start, end, metadata, span)


def _interval_problem(event: Event) -> Finding | None:
    """Return a finding if an interval is reversed or empty, as far as its bounds are relative to the same moment."""
    start, end = event.start, event.end
    comparable = start.relative == end.relative and not (start.relative and (start.ns < 0) != (end.ns < 0))
    if not comparable or start.ns < end.ns:
        return None
    return interval_finding(event, start.ns == end.ns)


def interval_finding(event: Event, is_empty: bool) -> Finding:  # noqa: FBT001 - the one property of the interval
    """Return the finding for an event whose interval is empty, or else reversed."""
    start, end = format_time(event.start), format_time(event.end)
    message = f"{event.name!r} is empty: it starts and ends at {start}"
    if not is_empty:
        message = f"{event.name!r} ends at {end}, before its start {start}"
    return Finding("event-interval", Severity.ERROR, message, event.span, "correct start and end")


def _time(text: str) -> TimeBound | None:
    """Parse an instant, an offset, seconds since the epoch, or nanoseconds of 18 or 19 digits; None for other text."""
    if _EPOCH_NS.fullmatch(text):
        return TimeBound(int(text))
    number = _EPOCH_NUMBER.fullmatch(text)
    if number is None:
        try:
            return parse_time(text)
        except ValueError:
            return None
    return TimeBound(int(number[1]) * 10**9 + int((number[2] or "0").ljust(9, "0")))


def _value(cell: str) -> str | int | float | bool:
    if cell in {"true", "false"}:
        return cell == "true"
    if _NUMBER.fullmatch(cell):
        number = json.loads(cell)
        if repr(number) == cell or str(number).rstrip("0") == cell.rstrip("0"):
            return number
    return cell


def _header_findings(header: _Row, file: str) -> Iterator[Finding]:
    span = Span(file, header.line, 1, header.line + 1, 1)
    missing = [column for column in ("start", "end") if column not in header.cells]
    if missing:
        names = " and ".join(missing)
        hint = f"name the columns in the first row; it has {', '.join(header.cells)}"
        yield _finding(f"the column {names} is missing", span, hint)
    for column, count in Counter(header.cells).items():
        if count > 1:
            yield _finding(f"two columns have the name {column!r}", span, "rename one of them")


def _unusable(message: str, span: Span) -> EventFile:
    return EventFile((), (_finding(message, span, "write a CSV file with the columns name, start and end"),))


def _finding(message: str, span: Span, hint: str) -> Finding:
    return Finding("event-file", Severity.ERROR, message, span, hint)
