"""Split a job into one job per part of its recording (`split`).

Each part is a separate job, so a part has the rows that `bag.time` with the part's range would select. If the times of
all topics are log times, the index of the recording decides which parts have messages, and each part reads only its own
range. Otherwise the recording is read once more to find the log times between which the messages of each part lie.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.decode.decoder import decoder_for
from mosaico_ingest.errors import IngestError, ManifestError
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.job.manifest import refusal
from mosaico_ingest.job.model import Job, TopicSettings
from mosaico_ingest.job.split import Event, SequencePart, clean_name, interval_finding, overlaps, read_events
from mosaico_ingest.job.values import StampSource, select
from mosaico_ingest.pipeline.selection import Mask, block_times, time_range
from mosaico_ingest.pipeline.task import open_job
from mosaico_ingest.rosbag.blocks import Int64s
from mosaico_ingest.rosbag.recording import Recording

MAX_PARTS = 1000
"""Maximum number of sequences that one recording may be split into."""


def split_job(job: Job) -> tuple[Job, ...]:
    """Return a job for each part of the recording that has messages.

    A job without `split` is returned unchanged. If the recording cannot be opened or has no such part, the job is also
    returned unchanged, and its run reports the reason.

    Raises:
        ManifestError: The event file has mistakes, or the recording would have more than `MAX_PARTS` parts.
    """
    if job.split is None or job.part is not None:
        return (job,)
    events = _usable_events(job)
    try:
        with open_job(job) as (recording, _):
            times = _message_times(job, recording)
            parts = tuple(_parts(job, recording, times, events))
    except ManifestError:
        raise
    except IngestError:
        return (job,)
    return tuple(_job_of_part(job, part) for part in parts) or (job,)


class _Part(Struct, frozen=True):
    part: SequencePart
    event: Event | None = None


class _MessageTimes(Struct, frozen=True):
    """The times of all messages of the selected topics, each shape (n,)."""

    log: Int64s
    selected: Int64s
    all_by_log: bool
    """Whether the selected time of every topic is the log time."""
    has_every: bool
    """Whether a topic counts messages with `every`, which requires reading from its first message."""

    def part(self, part: SequencePart) -> SequencePart | None:
        """Return a part with the log times of its messages, None if it has no messages."""
        inside: Mask = (self.selected >= part.start_ns) & (self.selected < part.end_ns)
        if not inside.any():
            return None
        if self.all_by_log or self.has_every:
            return part
        log = self.log[inside]
        return replace(part, read_from_ns=int(log.min()), read_until_ns=int(log.max()) + 1)


def _usable_events(job: Job) -> tuple[Event, ...]:
    """Return the events of the job; raise ManifestError if the file has mistakes."""
    if job.split is None or job.split.events is None:
        return ()
    file = read_events(Path(job.split.events))
    if file.findings:
        raise refusal(file.findings, job.split.events)
    return file.events


def _job_of_part(job: Job, planned: _Part) -> Job:
    assert job.split is not None  # noqa: S101 - only jobs with `split` have parts
    part, event = planned.part, planned.event
    name = job.split.sequence_name(part.recording, part.number, clean_name(part.event or str(part.number)))
    metadata = job.sequence.metadata if event is None else {**job.sequence.metadata, **event.metadata}
    return job.replace(sequence=job.sequence.replace(name=name, metadata=metadata), part=part).check()


def _parts(
    job: Job, recording: Recording, times: _MessageTimes, events: tuple[Event, ...]
) -> Iterator[_Part]:
    bounds = time_range(job, recording, has_log_times=times.all_by_log)
    if job.split is not None and job.split.by is not None:
        yield from _equal_parts(job, recording, times, job.split.by, bounds)
    else:
        yield from _event_parts(job, recording, times, events, bounds)


def _equal_parts(
    job: Job,
    recording: Recording,
    times: _MessageTimes,
    length_ns: int,
    bounds: tuple[int | None, int | None],
) -> Iterator[_Part]:
    """Yield the parts of equal length that have messages; numbers count the empty parts, too."""
    start_ns, end_ns = bounds
    inside = times.selected if start_ns is None else times.selected[times.selected >= start_ns]
    inside = inside if end_ns is None else inside[inside < end_ns]
    if not len(inside):
        return
    origin = start_ns
    if origin is None:
        first = int(inside.min())
        origin = first if not times.all_by_log or recording.start_ns is None else recording.start_ns
    positions = np.unique((inside - origin) // length_ns).tolist()
    if len(positions) > MAX_PARTS:
        _refuse(job, f"split.by makes {len(positions)} sequences", "by")
    for position in positions:
        start = origin + position * length_ns
        end = start + length_ns if end_ns is None else min(start + length_ns, end_ns)
        part = times.part(SequencePart(job.sequence.name, position + 1, start, end))
        if part is not None:
            yield _Part(part)


def _event_parts(
    job: Job,
    recording: Recording,
    times: _MessageTimes,
    events: tuple[Event, ...],
    bounds: tuple[int | None, int | None],
) -> Iterator[_Part]:
    """Yield a part for each event with messages; the first part has the findings about the file."""
    if len(events) > MAX_PARTS:
        _refuse(job, f"the file has {len(events)} events", "events")
    findings: list[Finding] = []
    intervals: list[tuple[int, int, Event]] = []
    parts: list[_Part] = []
    for event in events:
        start, end = _interval(event, recording)
        if start >= end:
            raise refusal((interval_finding(event, start == end),), str(event.span))
        intervals.append((start, end, event))
        start = start if bounds[0] is None else max(start, bounds[0])
        end = end if bounds[1] is None else min(end, bounds[1])
        part = times.part(SequencePart(job.sequence.name, event.number, start, end, event.name))
        if part is not None:
            parts.append(_Part(part, event))
            continue
        hint = "correct its times, or remove it; the recording has no message between them"
        message = (
            f"{event.name!r} selects no messages of {recording.files[0].name}, so it becomes no sequence"
        )
        findings.append(Finding("event-outside", Severity.WARNING, message, event.span, hint))
    findings += overlaps(intervals)
    if parts:
        first, *others = parts
        yield replace(first, part=replace(first.part, findings=tuple(findings)))
        yield from others


def _interval(event: Event, recording: Recording) -> tuple[int, int]:
    """Return the start and end of an event, ns since the epoch; offsets require an index, as in `bag.time`."""
    if event.start.relative or event.end.relative:
        if recording.start_ns is None or recording.end_ns is None:
            message = f"{event.name!r} has an offset, and the recording has no index, so its start is unknown"
            finding = Finding("event-file", Severity.ERROR, message, event.span, "write instants")
            raise refusal((finding,), str(event.span))
        first, last = recording.start_ns, recording.end_ns
        return event.start.at(first, last), event.end.at(first, last)
    return event.start.ns, event.end.ns


def _refuse(job: Job, message: str, key: str) -> None:
    span = job.span("split", key)
    hint = f"split one recording into at most {MAX_PARTS} sequences"
    finding = Finding("too-many-parts", Severity.ERROR, message, span, hint)
    raise ManifestError(message, where=job.where("split", key), hint=hint, findings=(finding,))


def _message_times(job: Job, recording: Recording) -> _MessageTimes:
    """Return the times of the messages of the selected topics, from the index or else by reading them."""
    selection = select(job.topics, tuple(dict.fromkeys(c.topic for c in recording.connections)))
    settings = {
        connection.id: job.settings_of(connection.topic)
        for connection in recording.connections
        if connection.topic in selection.selected and connection.definition is not None
    }
    indexed = [key for key, entry in settings.items() if entry.stamp is StampSource.LOG]
    by_index = recording.index_times(indexed) if indexed else {}
    pairs = [(times, times + settings[key].time_offset) for key, times in (by_index or {}).items()]
    unread = settings if by_index is None else settings.keys() - set(indexed)
    pairs += _read_times(recording, {key: settings[key] for key in unread})
    return _MessageTimes(
        np.concatenate([log for log, _ in pairs] or [np.zeros(0, np.int64)]),
        np.concatenate([selected for _, selected in pairs] or [np.zeros(0, np.int64)]),
        all_by_log=all(e.stamp is StampSource.LOG and not e.time_offset for e in settings.values()),
        has_every=any(entry.every > 1 for entry in settings.values()),
    )


def _read_times(recording: Recording, settings: dict[int, TopicSettings]) -> Iterable[tuple[Int64s, Int64s]]:
    """Yield the log times and the selected times of each message block of some connections."""
    if not settings:
        return
    decoders = {
        connection.id: decoder_for(connection)
        for connection in recording.connections
        if connection.id in settings
    }
    for block in recording.message_blocks(tuple(settings)):
        entry = settings[block.connection]
        selected = block_times(block, decoders[block.connection], entry.stamp, entry.time_offset)
        yield block.log_times, selected
