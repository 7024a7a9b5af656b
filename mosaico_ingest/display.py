"""Counts, sizes, rates and times as text for people."""

from __future__ import annotations

from datetime import datetime, timezone

_STEP = 1000.0


def bytes_text(size: float) -> str:
    """Return a size with a decimal unit, such as `1.5 MB`."""
    for unit in ("B", "kB", "MB", "GB"):
        if abs(size) < _STEP:
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
        size /= _STEP
    return f"{size:.1f} TB"


def count_text(count: int) -> str:
    """Return a count with separators, such as `12,345`."""
    return f"{count:,}"


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, such as `1 topic` or `12 topics`."""
    return f"{count_text(count)} {noun}{'' if count == 1 else 's'}"


def percent_text(share: float) -> str:
    """Return a share as a percentage, such as `17 %`."""
    return f"{share * 100:.0f} %"


def mean_rate_hz(count: int, start_ns: int | None, end_ns: int | None) -> float | None:
    """Return the mean rate of a topic: its intervals per second between its own first and last time stamp.

    None without an interval of positive length. Every rate that the package shows is computed by this function.
    """
    if start_ns is None or end_ns is None or end_ns <= start_ns:
        return None
    return (count - 1) / ((end_ns - start_ns) / 1e9)


def rate_text(rate_hz: float | None) -> str:
    """Return a rate with four digits, such as `29.97 Hz` or `100.0 Hz`; empty if it is unknown."""
    if rate_hz is None:
        return ""
    text = f"{rate_hz:.4g}"
    if rate_hz >= 1000:  # noqa: PLR2004 - four digits
        text = f"{rate_hz:,.0f}"
    elif "." not in text:
        text = f"{text}.0"
    return f"{text} Hz"


def interval_text(interval_ns: float | None) -> str:
    """Return a short interval, such as `2.5 ms`; empty if it is unknown."""
    if interval_ns is None:
        return ""
    for unit, size in (("s", 1e9), ("ms", 1e6), ("µs", 1e3)):
        if interval_ns >= size:
            return f"{interval_ns / size:.3g} {unit}"
    return f"{interval_ns:.0f} ns"


def seconds_text(seconds: float) -> str:
    """Return a duration, such as `0.42 s` or `1:02:03`."""
    if seconds < 60:  # noqa: PLR2004 - a minute
        return f"{seconds:.2f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"


def time_text(instant_ns: int | None) -> str:
    """Return an instant in UTC, such as `2026-01-01 00:00:00.000`; `-` if there is none."""
    if instant_ns is None:
        return "-"
    try:
        instant = datetime.fromtimestamp(instant_ns // 10**9, tz=timezone.utc)
    except (OverflowError, ValueError, OSError):
        return f"{instant_ns} ns"
    return f"{instant:%Y-%m-%d %H:%M:%S}.{instant_ns % 10**9 // 10**6:03}"


def stored_text(source_bytes: int, stored_bytes: int, *, of: str = "") -> str:
    """Return the stored size and its share of the source, such as `stored in 28.4 kB (17 % of 172.0 kB)`.

    `of` names the source if it is not the files of the recording, such as ` of messages`.
    """
    share = (
        f" ({percent_text(stored_bytes / source_bytes)} of {bytes_text(source_bytes)}{of})"
        if source_bytes
        else ""
    )
    return f"stored in {bytes_text(stored_bytes)}{share}"


def written_cell(messages: int, rows: int) -> str:
    """Return the number of written messages, with the number of rows if it differs, such as `12 (34 rows)`."""
    return count_text(messages) if messages == rows else f"{count_text(messages)} ({counted(rows, 'row')})"
