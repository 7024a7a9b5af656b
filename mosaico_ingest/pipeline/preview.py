"""Preview a run: the plan, the state of the destination, and a sample of messages."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from os.path import relpath
from pathlib import Path

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.bridge import ROSBridge
from mosaico_ingest.contracts.monitor import RecordingMonitor
from mosaico_ingest.destinations import (
    ExistingSequence,
    Session,
    StoredTopic,
    check_same_type,
    destination_of,
)
from mosaico_ingest.destinations.memory import MemorySink
from mosaico_ingest.display import counted
from mosaico_ingest.errors import IngestError, SinkError
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.job.model import Job
from mosaico_ingest.job.values import IfExists, LoaderErrorPolicy, TopicLevelErrorPolicy, first_match
from mosaico_ingest.pipeline.contract import attach_monitor, index_results, monitor_of, sample_results
from mosaico_ingest.pipeline.contract_check import results_by_job
from mosaico_ingest.pipeline.plan import Plan, TopicPlan, digest_of
from mosaico_ingest.pipeline.plan_document import (
    DestinationState,
    PlanDocument,
    RecordingPlan,
    Sample,
    SampleRejection,
    notes,
)
from mosaico_ingest.pipeline.planning import plan_recording
from mosaico_ingest.pipeline.provenance import StoredProvenance, is_repeatable, read_provenance
from mosaico_ingest.pipeline.run import preflight
from mosaico_ingest.pipeline.task import Task, open_job
from mosaico_ingest.pipeline.topic import TopicPipeline, link_outputs, pipelines_by_connection
from mosaico_ingest.pipeline.write_buffer import WriteBuffer
from mosaico_ingest.protocol import check_topic_name
from mosaico_ingest.report.events import Event, Rejected
from mosaico_ingest.report.parts import ContractResult, ExpectationResult
from mosaico_ingest.rosbag.blocks import MessageBlock
from mosaico_ingest.rosbag.recording import Recording
from mosaico_ingest.version import __version__

MESSAGES = 16
"""Number of messages per topic in the sample."""
_MEMORY_BYTES = 32 << 20
_SAMPLE_BYTES, _REMOTE_SAMPLE_BYTES = 64 << 20, 4 << 20
"""Bytes read to find the messages of the sample; topics that are still missing are then read by the index."""
_SAMPLE_S = 5.0
MAX_FINDINGS = 1000
"""Findings that the error about recordings that cannot be planned contains."""


def ask_destination(plan: Plan, samples: Iterable[Sample], *, connect: bool) -> DestinationState:
    """Return the state of the destination; a server is contacted only with `connect`."""
    destination = destination_of(plan.destination)
    status = destination.inspect(plan.sequence.name, connect=connect)
    has_sequence: bool | None = None if status.exists is None else status.sequence is not None
    problem = status.problem
    if problem is None and status.sequence is not None:
        problem = _sequence_problem(plan, status.sequence)
    return DestinationState(
        kind=destination.kind,
        exists=status.exists,
        has_sequence=has_sequence if status.problem is None else None,
        problem=problem,
        free_bytes=status.free_bytes,
        estimated_bytes=_estimate(plan, {sample.target: sample for sample in samples}),
    )


def space_finding(state: DestinationState) -> Finding | None:
    """Return a warning if the rows may not fit on the disk."""
    if state.free_bytes is None or state.estimated_bytes is None or state.estimated_bytes <= state.free_bytes:
        return None
    return Finding(
        "disk-space",
        Severity.WARNING,
        f"the rows take {state.estimated_bytes} bytes before compression, and {state.free_bytes} are free",
        help="free some space, or choose another target.store",
    )


def _sequence_problem(plan: Plan, existing: ExistingSequence) -> str | None:
    """Return why a plan cannot write a sequence that exists, None if it can."""
    if plan.sequence.if_exists is IfExists.FAIL:
        if is_repeatable(read_provenance(plan), StoredProvenance.of(existing)):
            return None
        return f"there is a sequence {plan.sequence.name!r}, and sequence.if_exists is fail"
    if plan.sequence.if_exists is IfExists.APPEND:
        try:
            for topic in plan.topics:
                stored = existing.topics.get(check_topic_name(topic.target))
                if stored is not None:
                    check_same_type(stored.ontology, topic.ontology, where=topic.target)
        except SinkError as error:
            return str(error)
    return None


def _estimate(plan: Plan, samples: dict[str, Sample]) -> int | None:
    """Return the uncompressed bytes of all rows, None if the index or the sample lacks a number."""
    sizes = [_topic_bytes(topic, samples[topic.target]) for topic in plan.topics if topic.count != 0]
    if any(size is None for size in sizes):
        return None
    return round(sum(size or 0 for size in sizes) * _share(plan))


def _topic_bytes(topic: TopicPlan, sample: Sample) -> int | None:
    if topic.count is None or sample.row_bytes is None:
        return None
    return -(-topic.count // topic.every) * sample.row_bytes


def _share(plan: Plan) -> float:
    """Return the share of the recording's duration that is read, from 0 to 1."""
    if plan.start_ns is None or plan.end_ns is None or plan.end_ns <= plan.start_ns:
        return 1.0
    start = max(plan.start_ns, plan.read_from_ns if plan.read_from_ns is not None else plan.start_ns)
    end = min(plan.end_ns, plan.read_until_ns if plan.read_until_ns is not None else plan.end_ns)
    return max(0.0, (end - start) / (plan.end_ns - plan.start_ns))


def try_messages(
    plan: Plan, recording: Recording, monitor: RecordingMonitor | None = None
) -> tuple[Sample, ...]:
    """Decode and adapt the first messages of every topic of the plan, without writing; `monitor` observes them."""
    with MemorySink().open(plan.sequence.name, plan.sequence.metadata) as session:
        counts = _counts(plan, recording)
        trials = tuple(_trial(topic, recording, session, counts) for topic in plan.topics)
        link_outputs([trial.topic for trial in trials])
        pipelines = pipelines_by_connection(trial.topic for trial in trials)
        if monitor is not None:
            attach_monitor(monitor, pipelines)
        with WriteBuffer(max_bytes=_MEMORY_BYTES) as buffer:
            for block in _blocks(plan, recording, pipelines):
                pipelines[block.connection].process(block, buffer)
    stored = {topic.topic: topic for topic in session.stored()}
    return tuple(trial.sample(stored.get(trial.topic.plan.target)) for trial in trials)


@dataclass(slots=True)
class _Rejections:
    """An observer that collects rejections by rule."""

    by_rule: dict[str, Rejected] = field(default_factory=dict[str, Rejected])

    def __call__(self, event: Event) -> None:
        if isinstance(event, Rejected):
            earlier = self.by_rule.get(event.rule)
            self.by_rule[event.rule] = (
                event if earlier is None else replace(earlier, count=earlier.count + event.count)
            )


class _Trial(Struct, frozen=True):
    topic: TopicPipeline
    rejections: _Rejections
    count: int | None

    def sample(self, stored: StoredTopic | None) -> Sample:
        rejections = tuple(
            SampleRejection(stage=event.stage, rule=event.rule, count=event.count, reason=event.reason)
            for event in self.rejections.by_rule.values()
        )
        return Sample(
            target=self.topic.plan.target,
            count=self.count,
            read=self.topic.read,
            rejected=sum(rejection.count for rejection in rejections),
            row_bytes=-(-stored.stored_bytes // self.topic.written) if stored and stored.rows else None,
            rejections=rejections,
        )


def _counts(plan: Plan, recording: Recording) -> Mapping[int, int | None]:
    """Return the number of messages of each connection in the time range; None if the index has no numbers."""
    if plan.read_from_ns is None and plan.read_until_ns is None:
        return {connection.id: connection.count for connection in recording.connections}
    connections = [connection for topic in plan.read_topics for connection in topic.connections]
    is_indexed = not plan.selects_after_reading and not recording.is_remote
    times = (
        recording.index_times(connections, start_ns=plan.read_from_ns, end_ns=plan.read_until_ns)
        if is_indexed  # behind a URL, the index takes one request per chunk
        else None
    )
    return {key: None if times is None else len(times[key]) for key in connections}


def _trial(
    topic: TopicPlan, recording: Recording, session: Session, counts: Mapping[int, int | None]
) -> _Trial:
    """Open a topic whose rejected messages do not end the sample."""
    rejections = _Rejections()
    lenient = topic.replace(on_error=TopicLevelErrorPolicy.Ignore)
    pipeline = TopicPipeline(lenient, LoaderErrorPolicy.IGNORE, session, rejections)
    connections = {connection.id: connection for connection in recording.connections}
    for connection in topic.connections:
        pipeline.bind(connections[connection])
    numbers = [count for key in topic.connections if (count := counts[key]) is not None]
    return _Trial(pipeline, rejections, sum(numbers) if len(numbers) == len(topic.connections) else None)


def _blocks(
    plan: Plan, recording: Recording, pipelines: Mapping[int, TopicPipeline]
) -> Iterator[MessageBlock]:
    """Yield message blocks until every topic has its sample; then read topics without any message by the index."""
    yield from _sample_blocks(plan, recording, pipelines, enough=MESSAGES)
    missing = {
        connection: pipeline
        for connection, pipeline in pipelines.items()
        if not pipeline.read and pipeline.plan.count
    }
    if missing:
        yield from _sample_blocks(plan, recording, missing, enough=1)


def _sample_blocks(
    plan: Plan, recording: Recording, pipelines: Mapping[int, TopicPipeline], *, enough: int
) -> Iterator[MessageBlock]:
    remaining_bytes = _REMOTE_SAMPLE_BYTES if recording.is_remote else _SAMPLE_BYTES
    deadline = time.monotonic() + _SAMPLE_S
    memory_bytes = min(remaining_bytes, _MEMORY_BYTES)
    blocks = recording.message_blocks(
        tuple(pipelines),
        start_ns=plan.read_from_ns,
        end_ns=plan.read_until_ns,
        max_rows=MESSAGES,
        memory_bytes=memory_bytes,
    )
    for block in blocks:
        remaining_bytes -= int(block.lengths.sum())
        if pipelines[block.connection].read < enough:
            yield block
        if all(pipeline.read >= enough for pipeline in pipelines.values()):
            return
        if remaining_bytes < 0 or time.monotonic() > deadline:
            return


def plan_recordings(jobs: Sequence[Job], *, connect: bool) -> Iterator[RecordingPlan]:
    """Yield the plan of each recording as soon as it is made; a recording that cannot be planned does not stop the others.

    Raises:
        IngestError: Jobs cannot be done; raised after the last plan. `findings` has the reasons of the first ones.
    """
    groups = results_by_job(jobs)
    failures = _Failures()
    for position, job in enumerate(jobs):
        try:
            plan = preview(job, connect=connect, group=groups.get(position, ()))
        except IngestError as error:  # noqa: PERF203 - the other recordings are planned nevertheless
            failures.add(error)
        else:
            yield plan
    failures.raise_if_any(len(jobs))


def plan_frame(manifest: Path, folder: Path) -> PlanDocument:
    """Return the plan document of a manifest without recordings, with paths relative to `folder`."""
    job = Path(relpath(manifest, folder)).as_posix()
    return PlanDocument(tool=f"mosaico-ingest {__version__}", job=job, recordings=())


class _Failures:
    """The errors of recordings that cannot be planned."""

    def __init__(self) -> None:
        self._gravest: IngestError | None = None
        """The first error with the lowest exit code."""
        self._count = 0
        self._findings: dict[Finding, None] = {}
        self._more = 0

    def add(self, error: IngestError) -> None:
        """Add the error of a recording."""
        self._count += 1
        if self._gravest is None or error.exit_code < self._gravest.exit_code:
            self._gravest = error
        for finding in error.findings or (Finding("plan-failed", Severity.ERROR, str(error)),):
            if len(self._findings) < MAX_FINDINGS:
                self._findings[finding] = None
            else:
                self._more += finding not in self._findings

    def raise_if_any(self, recordings: int) -> None:
        """Raise one error for all of them; with one recording, its own."""
        error = self._gravest
        if error is None:
            return
        if recordings > 1:
            error.what, error.where = f"{self._count} of {recordings} recordings cannot be ingested", None
            error.hint = None
            findings = list(self._findings)
            if self._more:
                findings.append(
                    Finding("plan-failed", Severity.ERROR, f"{counted(self._more, 'more finding')}")
                )
            error.findings = tuple(findings)
        raise error


def preview(job: Job, *, connect: bool, group: tuple[ExpectationResult, ...] = ()) -> RecordingPlan:
    """Plan a recording, convert a sample of its messages, and inspect the destination (a server only with `connect`).

    Raises:
        IngestError: The job cannot be done; the message states the reason.
    """
    bridge = ROSBridge.for_job(job)
    with open_job(job) as (recording, resolver):
        plan = plan_recording(Task(job, group=group), recording, bridge=bridge, resolver=resolver)
        results = index_results(plan, recording)
        monitor = monitor_of(plan, recording)
        samples = try_messages(plan, recording, monitor)
        if monitor is not None:
            results += sample_results(monitor)
        unreadable_ranges = tuple(_unreadable(recording))
    document = plan.document(folder=job.folder)
    state = ask_destination(plan, samples, connect=connect)
    warnings = preflight(plan) if connect and state.exists else ()
    destination_findings = (finding for finding in (space_finding(state), *warnings) if finding is not None)
    return RecordingPlan(
        digest=digest_of(document),
        plan=document,
        destination=state,
        samples=samples,
        contract=None
        if plan.contract is None
        else ContractResult(on_failure=plan.contract.expect.on_failure.value, results=tuple(results)),
        notes=notes(
            (
                *plan.findings,
                *unreadable_ranges,
                *_chosen(job, plan),
                *_excluded(plan),
                *destination_findings,
                *(finding for result in results if (finding := result.finding) is not None),
            )
        ),
    )


def _unreadable(recording: Recording) -> Iterator[Finding]:
    for item in recording.unreadable:
        where = f"{Path(item.file).name} at {item.offset}" if item.file else "the recording"
        yield Finding("unreadable-range", Severity.WARNING, f"{where}: {item.reason}")


def _chosen(job: Job, plan: Plan) -> Iterator[Finding]:
    """Yield a finding for each topic with an adapter override, with its location in the manifest."""
    for topic in plan.topics:
        glob = first_match(job.adapters.override, topic.topic)
        if glob is not None:
            span = job.span("adapters", "override", glob)
            yield Finding(
                "adapter-override", Severity.INFO, f"{topic.topic}: {topic.adapter.name} by {glob!r}", span
            )


def _excluded(plan: Plan) -> Iterator[Finding]:
    """Yield a finding for each topic that is not read, with the location in the manifest that excludes it."""
    for topic in plan.excluded:
        severity = Severity.WARNING if topic.undefined else Severity.INFO
        yield Finding("skipped-topic", severity, f"{topic.topic}: {topic.why}", topic.span)
