"""This file sends a recording's first messages through the pipeline, into memory: how a plan tells a wrong definition."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from mosaico_ingest.bag.batch import RawBatch
from mosaico_ingest.bag.recording import Recording
from mosaico_ingest.frozen import frozen
from mosaico_ingest.plan.document import Sample, SampleRejection
from mosaico_ingest.plan.model import Plan, TopicPlan
from mosaico_ingest.policies import LoaderErrorPolicy, TopicLevelErrorPolicy
from mosaico_ingest.report.events import Event, Rejected
from mosaico_ingest.sink import MemorySink, Session, StoredTopic
from mosaico_ingest.stream import Stream
from mosaico_ingest.write_buffer import WriteBuffer

__all__ = ["try_messages"]

MESSAGES = 16
"""How many messages of each topic are enough."""
_MEMORY_BYTES = 32 << 20
_LOOK_BYTES = 64 << 20
"""How much is read in search of them; what the index knows of is looked up after that."""
_LOOK_S = 5.0


def try_messages(plan: Plan, recording: Recording) -> tuple[Sample, ...]:
    """Decode and adapt the first messages of every topic of the plan; nothing is written."""
    with MemorySink().open(plan.sequence, plan.metadata) as session:
        trials = tuple(_trial(topic, recording, session) for topic in plan.topics)
        by_channel = {channel: trial for trial in trials for channel in trial.stream.plan.channels}
        with WriteBuffer(max_bytes=_MEMORY_BYTES) as buffer:
            for batch in _first(plan, recording, by_channel):
                by_channel[batch.channel.id].stream.feed(batch, buffer)
    stored = {topic.topic: topic for topic in session.stored()}
    return tuple(trial.sample(stored.get(trial.stream.plan.target)) for trial in trials)


@dataclass(slots=True)
class _Tally:
    """An observer that keeps the rejections, by their rules."""

    rejections: dict[str, Rejected] = field(default_factory=dict[str, Rejected])

    def __call__(self, event: Event) -> None:
        if isinstance(event, Rejected):
            known = self.rejections.get(event.rule)
            self.rejections[event.rule] = (
                event if known is None else replace(known, count=known.count + event.count)
            )


@frozen
class _Trial:
    stream: Stream
    tally: _Tally

    def sample(self, stored: StoredTopic | None) -> Sample:
        rejections = tuple(
            SampleRejection(stage=lost.stage, rule=lost.rule, count=lost.count, reason=lost.reason)
            for lost in self.tally.rejections.values()
        )
        return Sample(
            target=self.stream.plan.target,
            read=self.stream.seen,
            rejected=sum(lost.count for lost in rejections),
            row_bytes=-(-stored.stored_bytes // stored.rows) if stored and stored.rows else None,
            rejections=rejections,
        )


def _trial(topic: TopicPlan, recording: Recording, session: Session) -> _Trial:
    """Open a topic's stream so that a lost message costs nothing but itself."""
    tally = _Tally()
    patient = replace(topic, on_error=TopicLevelErrorPolicy.Ignore)
    stream = Stream(patient, LoaderErrorPolicy.IGNORE, session, tally)
    channels = {channel.id: channel for channel in recording.channels}
    for channel in topic.channels:
        stream.bind(channels[channel])
    return _Trial(stream, tally)


def _first(plan: Plan, recording: Recording, trials: dict[int, _Trial]) -> Iterator[RawBatch]:
    """Yield batches until every topic has enough; then, of those that had none, what the index knows of."""
    yield from _look(plan, recording, trials, enough=MESSAGES)
    absent = {
        channel: trial
        for channel, trial in trials.items()
        if not trial.stream.seen and trial.stream.plan.count
    }
    if absent:
        yield from _look(plan, recording, absent, enough=1)


def _look(plan: Plan, recording: Recording, trials: dict[int, _Trial], *, enough: int) -> Iterator[RawBatch]:
    left_bytes, until = _LOOK_BYTES, time.monotonic() + _LOOK_S
    batches = recording.batches(
        tuple(trials),
        start_ns=plan.read_from_ns,
        end_ns=plan.read_until_ns,
        rows=MESSAGES,
        memory_bytes=_MEMORY_BYTES,
    )
    for batch in batches:
        left_bytes -= int(batch.lengths.sum())
        if trials[batch.channel.id].stream.seen < enough:
            yield batch
        if all(trial.stream.seen >= enough for trial in trials.values()):
            return
        if left_bytes < 0 or time.monotonic() > until:
            return
