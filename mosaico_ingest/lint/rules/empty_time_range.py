"""The rule `empty-time-range`: a time range that selects nothing."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.job.units import parse_instant, parse_offset
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem if both ends are counted from the same moment and are in the wrong order."""
    time = job.manifest.bag.time
    if time is None or time.start is None or time.end is None:
        return
    start, end = _moment(time.start), _moment(time.end)
    if start[0] == end[0] and start[1] >= end[1]:
        yield Problem(
            f"{time.end} is not later than {time.start}", job.span("bag", "time", "end"), "exchange the two"
        )


def _moment(text: str) -> tuple[str, int]:
    """Return what a moment is counted from, and how far."""
    if text[0] in "+-":
        return text[0], parse_offset(text)
    return "epoch", parse_instant(text)


CHECK = Check("empty-time-range", job=check)
