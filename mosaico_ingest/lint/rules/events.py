"""The checks of `event-file`, `event-interval` and `event-overlap`: the file of events of `split`."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from mosaico_ingest.findings import Finding
from mosaico_ingest.job.split import Event, EventFile, overlaps, read_events
from mosaico_ingest.job.values import TimeBound
from mosaico_ingest.lint.check import Check, Job, Problem


def _problems(job: Job, rule: str) -> Iterator[Problem]:
    """Yield the problems of one rule; a file that does not exist is a problem of `missing-file`."""
    split = job.manifest.split
    if split is None or not job.is_expanded(split.events):
        return
    path = job.resolve(str(split.events))
    if path.is_file():
        for finding in _findings(read_events(path)):
            if finding.rule == rule and finding.span is not None:
                yield Problem(finding.message, finding.span, finding.help)


def _findings(file: EventFile) -> Iterator[Finding]:
    """Yield the findings of a file; overlaps only between events whose times are relative to the same moment."""
    yield from file.findings
    by_reference: dict[str, list[tuple[int, int, Event]]] = {}
    for event in file.events:
        reference = _reference(event.start)
        if reference == _reference(event.end):
            by_reference.setdefault(reference, []).append((event.start.ns, event.end.ns, event))
    for intervals in by_reference.values():
        yield from overlaps(intervals)


def _reference(bound: TimeBound) -> str:
    """Return the moment that a bound is relative to."""
    if not bound.relative:
        return "epoch"
    return "last message" if bound.ns < 0 else "first message"


CHECKS = tuple(
    Check(rule, job=partial(_problems, rule=rule), reads_files=True)
    for rule in ("event-file", "event-interval", "event-overlap")
)
