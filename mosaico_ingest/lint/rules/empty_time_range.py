"""The check of `empty-time-range`: a time range that selects nothing."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.job.values import TimeBound, format_time
from mosaico_ingest.lint.check import Check, Job, Problem


def check(job: Job) -> Iterator[Problem]:
    """Report a range whose end is not later than its start, if both are relative to the same moment."""
    time = job.manifest.bag.time
    if time.start is None or time.end is None:
        return
    if _reference(time.start) == _reference(time.end) and time.start.ns >= time.end.ns:
        message = f"the end {format_time(time.end)} is not later than the start {format_time(time.start)}"
        yield Problem(message, job.span("bag", "time", "end"), "swap the two values")


def _reference(bound: TimeBound) -> str:
    """Return the moment that a bound is relative to."""
    if not bound.relative:
        return "epoch"
    return "last message" if bound.ns < 0 else "first message"


CHECK = Check("empty-time-range", job=check)
