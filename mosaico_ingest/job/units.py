"""This file reads the small languages inside a manifest's texts: sizes, durations, instants."""

from __future__ import annotations

import re
from datetime import datetime, timezone
from typing import Final

__all__ = ["parse_instant", "parse_limit", "parse_offset", "parse_size"]

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
_INSTANT = re.compile(
    r"(\d{4}-\d\d-\d\d)(?:[Tt ](\d\d:\d\d(?::\d\d)?)(?:\.(\d{1,9}))?)? ?(Z|z|[+-]\d\d:\d\d)?"
)
_LIMIT = re.compile(r"([0-9]{1,18})|([0-9]{1,18}(?:\.[0-9]{1,18})?) ?%")
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)


def parse_size(text: str) -> int:
    """Return the bytes that `512MiB`, `2 GB` or `100kB` stand for.

    Raises:
        ValueError: The text is no size.
    """
    match = _SIZE.fullmatch(text)
    if match is None or match[2] not in _BYTES:
        raise ValueError(f"{text!r} is no size; write a number and a unit, as 512MiB or 2GB")
    return int(float(match[1]) * _BYTES[match[2]])


def parse_offset(text: str) -> int:
    """Return the nanoseconds of `+10s` or `-1.5min`; units ns us ms s min h.

    Raises:
        ValueError: The text is no offset.
    """
    match = _OFFSET.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} is no offset; write a sign, a number and a unit, as +10s or -1.5min")
    whole, _, fraction = match[2].partition(".")
    unit = _NANOSECONDS[match[3]]
    magnitude = int(whole) * unit + (int(fraction) * unit // 10 ** len(fraction) if fraction else 0)
    return -magnitude if match[1] == "-" else magnitude


def parse_limit(text: str) -> tuple[int | None, float | None]:
    """Return the number of `100`, or the share between 0 and 1 of `0.1%`; the other one is None.

    Raises:
        ValueError: The text is neither, or the share exceeds 100%.
    """
    match = _LIMIT.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} is no limit; write a number of messages, as 100, or a share, as 0.1%")
    if match[1]:
        return int(match[1]), None
    share = float(match[2]) / 100
    if share > 1:
        raise ValueError(
            f"{text!r} is more than 100%; write a share of at most 100%, or a number of messages"
        )
    return None, share


def parse_instant(text: str) -> int:
    """Return the nanoseconds since the epoch of an ISO 8601 date or date and time; UTC where no zone is given.

    Raises:
        ValueError: The text is no instant.
    """
    match = _INSTANT.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} is neither an instant (2026-03-01T12:00:00Z) nor an offset (+10s, -5min)")
    zone = "+00:00" if match[4] in {None, "Z", "z"} else match[4]
    moment = datetime.fromisoformat(f"{match[1]}T{match[2] or '00:00'}{zone}")
    since = moment - _EPOCH
    seconds = since.days * 86_400 + since.seconds
    return seconds * 1_000_000_000 + int((match[3] or "0").ljust(9, "0"))
