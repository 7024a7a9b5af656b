"""This file writes numbers for people."""

from __future__ import annotations

from datetime import datetime, timezone

__all__ = ["bytes_text", "count_text", "counted", "seconds_text", "time_text"]

_STEP = 1000.0


def bytes_text(size: float) -> str:
    """Return a size with a decimal unit, as `1.5 MB`."""
    for unit in ("B", "kB", "MB", "GB"):
        if abs(size) < _STEP:
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
        size /= _STEP
    return f"{size:.1f} TB"


def count_text(count: int) -> str:
    """Return a count with thin groups, as `12,345`."""
    return f"{count:,}"


def counted(count: int, noun: str) -> str:
    """Return a count with what is counted, as `1 topic` or `12 topics`."""
    return f"{count_text(count)} {noun}{'' if count == 1 else 's'}"


def seconds_text(seconds: float) -> str:
    """Return a duration, as `0.42 s` or `1:02:03`."""
    if seconds < 60:  # noqa: PLR2004 - a minute
        return f"{seconds:.2f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"


def time_text(instant_ns: int | None) -> str:
    """Return an instant in UTC, as `2026-01-01 00:00:00.000`."""
    if instant_ns is None:
        return "-"
    try:
        at = datetime.fromtimestamp(instant_ns // 10**9, tz=timezone.utc)
    except (OverflowError, ValueError, OSError):
        return f"{instant_ns} ns"
    return f"{at:%Y-%m-%d %H:%M:%S}.{instant_ns % 10**9 // 10**6:03}"
