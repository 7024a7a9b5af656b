"""The notations inside a manifest's texts: sizes, limits, offsets and instants."""

from __future__ import annotations

import re
from datetime import datetime, timezone
from typing import Final

from mosaico_ingest.job.values import Interval, Limit, TimeBound

_SIZE = re.compile(r"([0-9]{1,18}(?:\.[0-9]{1,18})?) ?([kKMGT]?i?B)")
_BYTES: Final = {
    "B": 1,
    **{f"{letter}B": 1000**power for power, letter in enumerate(("k", "M", "G", "T"), 1)},
    **{f"{letter}iB": 1024**power for power, letter in enumerate(("K", "M", "G", "T"), 1)},
    "KB": 1000,
    "kiB": 1024,
}
_OFFSET = re.compile(r"([+-])([0-9]{1,18}(?:\.[0-9]{1,18})?) ?(ns|us|ms|s|min|h)")
_NANOSECONDS: Final = {
    "ns": 1,
    "us": 1_000,
    "ms": 1_000_000,
    "s": 1_000_000_000,
    "min": 60_000_000_000,
    "h": 3_600_000_000_000,
}
_DURATION = re.compile(r"([+-]?)([0-9]{1,18}(?:\.[0-9]{1,18})?) ?(ns|us|ms|s|min|h|d)")
_LONG_UNITS: Final = {**_NANOSECONDS, "d": 86_400_000_000_000}
_NUMBER = r"([0-9]{1,18}(?:\.[0-9]{1,18})?)"
_RATE = re.compile(_NUMBER + r" ?(mHz|Hz|kHz|/s|/min|/h)")
_HERTZ: Final = {"mHz": 1e-3, "Hz": 1.0, "kHz": 1e3, "/s": 1.0, "/min": 1 / 60, "/h": 1 / 3600}
_SHARE = re.compile(_NUMBER + r" ?%")
_PERIODS = re.compile(_NUMBER + r" ?periods?")
_INSTANT = re.compile(
    r"(\d{4}-\d\d-\d\d)(?:[Tt ](\d\d:\d\d(?::\d\d)?)(?:\.(\d{1,9}))?)? ?(Z|z|[+-]\d\d:\d\d)?"
)
_LIMIT = re.compile(r"([0-9]{1,18})|([0-9]{1,18}(?:\.[0-9]{1,18})?) ?%")
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_INT64 = range(-(2**63), 2**63)
"""Range of times in a recording, in nanoseconds."""


def parse_size(text: str) -> int:
    """Parse a size such as `512MiB`, `2 GB` or `100kB`; return bytes.

    Raises:
        ValueError: The text is not a size.
    """
    match = _SIZE.fullmatch(text)
    if match is None or match[2] not in _BYTES:
        raise ValueError(f"{text!r} is not a size; write a number and a unit, such as 512MiB or 2GB")
    return int(float(match[1]) * _BYTES[match[2]])


def parse_limit(text: str) -> Limit:
    """Parse a limit: a number (`100`) or a share (`0.1%`).

    Raises:
        ValueError: The text is neither a number nor a share, or the share is more than 100%.
    """
    match = _LIMIT.fullmatch(text)
    if match is None:
        raise ValueError(
            f"{text!r} is not a limit; write a number of messages, such as 100, or a share, such as 0.1%"
        )
    if match[1]:
        return Limit(count=int(match[1]))
    share = float(match[2]) / 100
    if share > 1:
        raise ValueError(f"{text!r} is out of range; write a share from 0% to 100%")
    return Limit(share=share)


def parse_time(text: str) -> TimeBound:
    """Parse an instant (`2026-03-01T12:00:00Z`) or an offset (`+10s`, `-5min`).

    Raises:
        ValueError: The text is neither an instant nor an offset.
    """
    if text[:1] in {"+", "-"}:
        return TimeBound(parse_offset(text), relative=True)
    return TimeBound(parse_instant(text))


def format_time(bound: TimeBound) -> str:
    """Format a bound in the notation of manifests."""
    if bound.relative:
        seconds, rest = divmod(abs(bound.ns), 1_000_000_000)
        fraction = f".{rest:09}".rstrip("0") if rest else ""
        return f"{'-' if bound.ns < 0 else '+'}{seconds}{fraction}s"
    seconds, rest = divmod(bound.ns, 1_000_000_000)
    moment = datetime.fromtimestamp(seconds, tz=timezone.utc)
    fraction = f".{rest:09}".rstrip("0") if rest else ""
    return f"{moment:%Y-%m-%dT%H:%M:%S}{fraction}Z"


def parse_offset(text: str) -> int:
    """Parse an offset such as `+10s` or `-1.5min` in ns, us, ms, s, min or h; return nanoseconds.

    Raises:
        ValueError: The text is not an offset, or the offset exceeds 292 years.
    """
    match = _OFFSET.fullmatch(text)
    if match is None:
        raise ValueError(
            f"{text!r} is not an offset; write a sign, a number and a unit, such as +10s or -1.5min"
        )
    whole, _, fraction = match[2].partition(".")
    unit = _NANOSECONDS[match[3]]
    magnitude = int(whole) * unit + (int(fraction) * unit // 10 ** len(fraction) if fraction else 0)
    if magnitude not in _INT64:
        raise ValueError(f"{text!r} is out of range; write an offset of at most 292 years (2562047h)")
    return -magnitude if match[1] == "-" else magnitude


def parse_duration(text: str, *, signed: bool = False) -> int:
    """Parse a duration such as `50 ms`, `1.5h` or `2 d`, with `signed` also `-5 ms`; return nanoseconds.

    Raises:
        ValueError: The text is not a duration, or the duration exceeds 292 years.
    """
    match = _DURATION.fullmatch(text)
    if match is None or (match[1] and not signed):
        raise ValueError(f"{text!r} is not a duration; write a number and a unit, such as 50 ms, 30s or 2h")
    whole, _, fraction = match[2].partition(".")
    unit = _LONG_UNITS[match[3]]
    length = int(whole) * unit + (int(fraction) * unit // 10 ** len(fraction) if fraction else 0)
    if length not in _INT64:
        raise ValueError(f"{text!r} is out of range; write a duration of at most 292 years (2562047h)")
    return -length if match[1] == "-" else length


def format_duration(ns: int) -> str:
    """Format a duration in the largest unit that represents it exactly, such as `50 ms`."""
    unit = next((unit for unit in ("h", "min", "s", "ms", "us") if ns and ns % _NANOSECONDS[unit] == 0), "ns")
    return f"{ns // _NANOSECONDS[unit]} {unit}"


def parse_rate(text: str) -> float:
    """Parse a rate such as `95 Hz`, `2 kHz` or `10/min`; return hertz.

    Raises:
        ValueError: The text is not a rate.
    """
    match = _RATE.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} is not a rate; write a number and a unit, such as 95 Hz or 10/min")
    return float(match[1]) * _HERTZ[match[2]]


def parse_share(text: str) -> float:
    """Parse a share such as `5%`; return a number from 0 to 1.

    Raises:
        ValueError: The text is not a share, or is more than 100%.
    """
    match = _SHARE.fullmatch(text)
    if match is None or float(match[1]) > 100:  # noqa: PLR2004 - percent
        raise ValueError(f"{text!r} is not a share; write a number from 0% to 100%, such as 5%")
    return float(match[1]) / 100


def parse_interval(text: str) -> Interval:
    """Parse a duration (`100 ms`) or a multiple of a topic's period (`2 periods`).

    Raises:
        ValueError: The text is neither of the two.
    """
    match = _PERIODS.fullmatch(text)
    if match is not None:
        return Interval(periods=float(match[1]))
    try:
        return Interval(ns=parse_duration(text))
    except ValueError:
        message = f"{text!r} is neither a duration nor a number of periods; write 100 ms or 2 periods"
        raise ValueError(message) from None


def parse_instant(text: str) -> int:
    """Parse an ISO 8601 date, or date and time (UTC by default); return nanoseconds since the epoch.

    Raises:
        ValueError: The text is not an instant, or is not between 1678 and 2262.
    """
    match = _INSTANT.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} is neither an instant (2026-03-01T12:00:00Z) nor an offset (+10s, -5min)")
    zone = "+00:00" if match[4] in {None, "Z", "z"} else match[4]
    moment = datetime.fromisoformat(f"{match[1]}T{match[2] or '00:00'}{zone}")
    since = moment - _EPOCH
    seconds = since.days * 86_400 + since.seconds
    instant = seconds * 1_000_000_000 + int((match[3] or "0").ljust(9, "0"))
    if instant not in _INT64:
        raise ValueError(f"{text!r} is out of range; write an instant between the years 1678 and 2262")
    return instant
