"""`empty-time-range`: a time range with nothing in it.

`start` is the first moment that is in and `end` the first that is out; an end that is not later leaves nothing.

Bad:
    bag:
      path: data/run.mcap
      time: {start: +20s, end: +10s}

Good:
    bag:
      path: data/run.mcap
      time: {start: +10s, end: +20s}
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.job.units import parse_instant, parse_offset
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Problem, Rule


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


RULE = Rule("ING231", __name__, Severity.ERROR, __doc__, job=check)
