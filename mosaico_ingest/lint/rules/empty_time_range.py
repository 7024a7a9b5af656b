"""The check of `empty-time-range`: a time range that selects nothing."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.job.units import parse_instant, parse_offset
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Report a range whose end is not later than its start, if both are relative to the same moment."""
    time = job.manifest.bag.time
    if time is None or time.start is None or time.end is None:
        return
    start, end = _moment(time.start), _moment(time.end)
    if start[0] == end[0] and start[1] >= end[1]:
        message = f"the end {time.end} is not later than the start {time.start}"
        yield Problem(message, job.span("bag", "time", "end"), "swap the two values")


def _moment(text: str) -> tuple[str, int]:
    """Return the reference point (`+` start, `-` end, epoch) and the distance from it in nanoseconds."""
    if text[0] in "+-":
        return text[0], parse_offset(text)
    return "epoch", parse_instant(text)


CHECK = Check("empty-time-range", job=check)
