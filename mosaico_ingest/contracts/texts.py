"""The texts of results: durations, limits and positions for people."""

from __future__ import annotations

from math import isfinite
from typing import Any

from mosaico_ingest.job.units import format_time
from mosaico_ingest.job.values import Limit, TimeBound
from mosaico_ingest.report.contract import Occurrence
from mosaico_ingest.report.units import count_text

_UNITS = (
    (3_600_000_000_000, "h"),
    (60_000_000_000, "min"),
    (1_000_000_000, "s"),
    (1_000_000, "ms"),
    (1_000, "us"),
)
_SHORT_NS = 120_000_000_000
"""Durations below two minutes are shown in seconds or smaller units."""


def duration(ns: float) -> str:
    """Return a duration in a suitable unit, such as `50 ms` or `1.5 h`."""
    size = abs(ns)
    if size < _SHORT_NS:
        unit, name = next(((unit, name) for unit, name in _UNITS[2:] if size >= unit), (1, "ns"))
    else:
        unit, name = next((unit, name) for unit, name in _UNITS if size >= unit)
    return f"{number(ns / unit)} {name}"


def number(value: float) -> str:
    """Return a number with at most six significant digits and thousands separators for whole numbers."""
    if isfinite(value) and abs(value) < 1e15 and value == int(value):  # noqa: PLR2004 - exact
        return count_text(int(value))
    return f"{value:.6g}"


def share(value: float) -> str:
    """Return a share as a percentage, such as `0.15%`."""
    return f"{100 * value:.4g}%"


def instant(ns: int) -> str:
    """Return an instant in ISO 8601."""
    try:
        return format_time(TimeBound(ns))
    except (OverflowError, ValueError, OSError):
        return f"{ns} ns"


def part(limit: Limit, count: int, total: int, what: str) -> str:
    """Return the part of a total that a limit applies to, such as `3 of 20 messages were rejected (15%)`."""
    percentage = f" ({share(count / total)})" if limit.count is None and total else ""
    return f"{count_text(count)} of {count_text(total)} {what}{percentage}"


def limit(limit: Limit) -> str:
    """Return a maximum number or share of messages."""
    return (
        f"at most {count_text(limit.count)}"
        if limit.count is not None
        else f"at most {share(limit.share or 0)}"
    )


def bounds(low: str | None, high: str | None) -> str:
    """Return a range such as `from 95 Hz to 105 Hz`, `at least 95 Hz` or `at most 105 Hz`."""
    if low is not None and high is not None:
        return f"from {low} to {high}"
    return f"at least {low}" if low is not None else f"at most {high}"


def position(where: Occurrence) -> str:
    """Return the position of an occurrence, such as `2026-01-01T00:00:04.1Z (message 410)`."""
    time = "" if where.log_time_ns is None else instant(where.log_time_ns)
    index = "" if where.index is None else f"message {count_text(where.index)}"
    return f"{time} ({index})" if time and index else time or index


def extremes(first: Occurrence | None, worst: Occurrence | None) -> str:
    """Return where the first and the worst violation are, to be appended to a text."""
    if worst is None or (worst.log_time_ns is None and worst.index is None):
        return ""
    if first is None or (first.log_time_ns, first.index) == (worst.log_time_ns, worst.index):
        return f"; at {position(worst)}"
    return f"; first at {position(first)}, worst at {position(worst)}"


def value(data: Any) -> str:  # noqa: ANN401 - any value of an occurrence
    """Return a value of a message."""
    if data is None:
        return "null"
    if isinstance(data, bool):
        return "true" if data else "false"
    return number(data) if isinstance(data, int | float) else repr(data)
