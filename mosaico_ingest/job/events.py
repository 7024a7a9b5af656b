"""Event files: CSV files of named intervals with metadata, for `split.events`."""

from __future__ import annotations

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec import Struct

from mosaico_ingest.findings import Finding, Severity, Span
from mosaico_ingest.job.units import format_time, parse_time
from mosaico_ingest.job.values import TimeBound
from mosaico_ingest.textfile import read_limited

_NUMBER = re.compile(r"-?(0|[1-9][0-9]*)(\.[0-9]+)?")
_EPOCH_NUMBER = re.compile(r"([0-9]{1,11})(?:\.([0-9]{1,9}))?")
_EPOCH_NS = re.compile(r"[0-9]{18,19}")
_REFUSED_KEY = re.compile(r"[^A-Za-z0-9 _-]+|-(?=-)")
_OWN_COLUMNS = ("name", "start", "end")


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
