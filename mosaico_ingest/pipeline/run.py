"""The run of one recording."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Generator, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path

from mosaico_ingest.adapters.bridge import ROSBridge
from mosaico_ingest.destinations.base import Session, Sink, StoredTopic
from mosaico_ingest.destinations.registry import destination_of
from mosaico_ingest.errors import IngestError, Interrupted, NothingMatched, VerificationError
from mosaico_ingest.findings import Finding, Severity, Stage
from mosaico_ingest.interrupts import DeferredInterrupt
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.values import IfExists, SessionLevelErrorPolicy
from mosaico_ingest.pipeline.plan import Plan
from mosaico_ingest.pipeline.planning import resolve
from mosaico_ingest.pipeline.provenance import enter
from mosaico_ingest.pipeline.quarantine import Quarantine
from mosaico_ingest.pipeline.topic import Stream
from mosaico_ingest.pipeline.write_buffer import WriteBuffer
from mosaico_ingest.report.collect import Collector
from mosaico_ingest.report.events import (
    Event,
    Expected,
    Noted,
    Observer,
    Quarantined,
    Rejected,
    RunFinished,
    RunStarted,
    RunStatus,
    Timed,
    TopicClosed,
    TopicProgress,
    Unreadable,
)
from mosaico_ingest.report.model import Report
from mosaico_ingest.report.timing import Step, Stopwatch
from mosaico_ingest.rosbag.definitions.registry import ROSTypeRegistry, TypeResolver
from mosaico_ingest.rosbag.recording import Recording, open_recording

__all__ = [
    "dry_run_report",
    "execute",
    "failed_report",
    "inject",
    "make_plan",
    "open_for",
    "preflight",
    "run_config",
]


def inject(
    plan: Plan, recording: Recording, sink: Sink, observe: Observer, watch: Stopwatch | None = None
) -> None:
    """Read what the plan names, adapt it, write it, and check what the destination then holds.

    Raises:
        IngestError: What ended the run; under the `report` policy the rows accepted before it are kept.
        VerificationError: The destination does not hold what was written.
    """
    watch = watch or Stopwatch()
    failure: BaseException | None = None
    missing: list[str] = []
    quarantine = _open_quarantine(plan)
    streams: tuple[Stream, ...] = ()
    try:
        with (
            DeferredInterrupt() as interrupt,
            sink.open(plan.sequence, plan.metadata, if_exists=plan.if_exists) as session,
        ):
            streams = _open_streams(plan, recording, session, observe, quarantine=quarantine, watch=watch)
            try:
                _pump(plan, recording, streams, observe, watch)
                missing = _missing(plan, recording, streams, observe)
                _check_not_empty(plan, streams)
            except BaseException as error:
                # Every way to end early, Ctrl-C too, is the session policy's to judge.
                failure = _as_interrupt(error)
                if plan.on_error is SessionLevelErrorPolicy.Delete or not any(s.rows for s in streams):
                    raise failure from error
                session.note_error(str(failure))
            if quarantine is not None:
                quarantine.close()
            if not isinstance(failure, Interrupted):
                interrupt.defer()  # all is read: a commit that is cut off would lose it
    except BaseException as error:
        reported = _as_interrupt(error)
        _account_for_discard(streams, quarantine, reported, observe)
        if reported is error:
            raise
        raise reported from error
    if quarantine is not None:
        _report_quarantine(quarantine, plan.if_exists, observe)
    wrong = missing + _close(session.stored(), streams, observe, failure=failure)
    if failure is not None:
        raise failure
    _check_stored(wrong, interrupted=interrupt.asked)


def _check_stored(wrong: list[str], *, interrupted: bool) -> None:
    """Raise where the destination does not hold what was written, or an interrupt waited for it."""
    if wrong:
        raise VerificationError(
            "; ".join(wrong), hint="what is stored is incomplete; replace it, and report this as a mistake"
        )
    if interrupted:
        raise Interrupted("stopped; all of this recording is stored")


def _report_quarantine(quarantine: Quarantine, if_exists: IfExists, observe: Observer) -> None:
    """Say what is kept of a session that is committed; what was kept of one it replaced is no longer needed."""
    if if_exists is IfExists.REPLACE:
        quarantine.supersede()
    if quarantine.kept:
        observe(Noted(_kept(quarantine)))
        observe(Quarantined(str(quarantine.messages_path)))


def _account_for_discard(
    streams: tuple[Stream, ...], quarantine: Quarantine | None, error: BaseException, observe: Observer
) -> None:
    """Account for a session that leaves nothing behind."""
    for stream in streams:
        _take_back(stream, stream.rows, f"the session was discarded: {error}", observe)
        observe(TopicClosed(stream.plan.target, stream.status, 0, error=stream.error))
    if quarantine is not None:
        quarantine.discard()


def _open_quarantine(plan: Plan) -> Quarantine | None:
    if plan.quarantine is None:
        return None
    counts = [topic.count for topic in plan.topics]
    promised = None if None in counts else sum(count or 0 for count in counts)
    return Quarantine(plan.quarantine, plan.sequence, promised, name=plan.kept_as)


def _kept(quarantine: Quarantine) -> Finding:
    return Finding(
        "quarantined",
        Severity.WARNING,
        f"{quarantine.kept} messages lie in {quarantine.messages_path}",
        help=f"mend the manifest, then `ingest replay {quarantine.messages_path.parent} --manifest JOB.yaml`",
    )


def _as_interrupt(error: BaseException) -> BaseException:
    """Return Ctrl-C as `Interrupted`, any other error as it is."""
    if isinstance(error, KeyboardInterrupt):
        return Interrupted("stopped before the end of the recording", hint="run the job again for all of it")
    return error


def _open_streams(
    plan: Plan,
    recording: Recording,
    session: Session,
    observe: Observer,
    *,
    quarantine: Quarantine | None,
    watch: Stopwatch,
) -> tuple[Stream, ...]:
    connections = {connection.id: connection for connection in recording.connections}
    streams: list[Stream] = []
    for topic in plan.topics:
        stream = Stream(topic, plan.on_message_error, session, observe, quarantine=quarantine, watch=watch)
        for connection_id in topic.connections:
            stream.bind(connections[connection_id])
        streams.append(stream)
    return tuple(streams)


def _pump(
    plan: Plan, recording: Recording, streams: tuple[Stream, ...], observe: Observer, watch: Stopwatch
) -> None:
    """Move every batch of the recording through its stream, writing on a thread of its own."""
    by_connection = {connection: stream for stream in streams for connection in stream.plan.connections}
    said = frozenset(recording.unreadable)  # by a finding of the recording itself
    buffer = WriteBuffer(max_bytes=plan.memory_bytes // 4)
    try:
        _feed(plan, recording, by_connection, buffer, watch)
    finally:
        watch.lap(Step.WAIT)
        watch.add(Step.WRITE, buffer.busy_s)
    for stream in streams:
        if stream.padded:
            observe(Noted(_padded(stream)))
    for item in recording.unreadable:
        stream = by_connection.get(item.connection) if item.connection is not None else None
        if item.count == 0 and item in said:
            continue
        if item.count == 0:
            observe(
                Noted(
                    Finding(
                        "recovered-range",
                        Severity.INFO,
                        f"{item.file} at {item.offset}: {item.reason}",
                    )
                )
            )
        else:
            observe(
                Unreadable(
                    stream.plan.target if stream else None,
                    item.count,
                    item.offset,
                    item.reason,
                )
            )


def _feed(
    plan: Plan, recording: Recording, streams: Mapping[int, Stream], buffer: WriteBuffer, watch: Stopwatch
) -> None:
    with buffer:
        batches = recording.message_blocks(
            tuple(streams),
            start_ns=plan.read_from_ns,
            end_ns=plan.read_until_ns,
            memory_bytes=plan.memory_bytes // 4,
        )
        watch.lap(Step.PREPARE)
        for batch in batches:
            watch.lap(Step.READ)
            streams[batch.connection].feed(batch, buffer)
            watch.lap(Step.ADAPT)
        watch.lap(Step.READ)


def _padded(stream: Stream) -> Finding:
    return Finding(
        "padded-messages",
        Severity.WARNING,
        f"{stream.plan.topic}: {stream.padded} messages end in 4 to 7 zero bytes that {stream.plan.msgtype} does not explain",
        help="they were read; check that the definition is the one they were written with",
    )


def _missing(plan: Plan, recording: Recording, streams: tuple[Stream, ...], observe: Observer) -> list[str]:
    """Hold what was read against what the index promises; return what is nowhere to be found."""
    if plan.read_from_ns is not None or plan.read_until_ns is not None:
        return []
    known = Counter[int]()
    for item in recording.unreadable:
        known.update({} if item.connection is None else {item.connection: item.count or 0})
    elsewhere = any(item.connection is None or item.count is None for item in recording.unreadable)
    wrong: list[str] = []
    for stream in streams:
        target, promised = stream.plan.target, stream.plan.count
        found = stream.seen + sum(known[connection] for connection in stream.plan.connections)
        if promised is None or promised == found:
            continue
        says = f"{target}: the index promises {promised} messages, {stream.seen} were read"
        if promised < found:
            observe(Noted(Finding("unexpected-messages", Severity.WARNING, says)))
        elif elsewhere:
            observe(Unreadable(target, promised - found, None, "they lie in what could not be read"))
        else:
            wrong.append(f"{says} and nothing says where the others are")
    return wrong


def _check_not_empty(plan: Plan, streams: tuple[Stream, ...]) -> None:
    """Refuse to commit a sequence without a row: it would look like one that was ingested."""
    if any(stream.rows for stream in streams):
        return
    read = sum(stream.seen for stream in streams)
    where = str(plan.files[0])
    if read == 0:
        window = plan.read_from_ns is not None or plan.read_until_ns is not None
        what = (
            "there is no message in the time window" if window else "there is no message in the topics taken"
        )
        raise NothingMatched(what, where=where, hint="nothing was written")
    why = next((stream.error for stream in streams if stream.error), "see the report for each reason")
    raise NothingMatched(f"none of {read} messages could be ingested", where=where, hint=why)


def _close(
    stored: tuple[StoredTopic, ...],
    streams: tuple[Stream, ...],
    observe: Observer,
    *,
    failure: BaseException | None,
) -> list[str]:
    """Close each stream in the report; return how the destination differs from what was written.

    After a failure, rows that were on their way are no difference: they are taken back from the count.
    """
    held = {topic.topic: topic for topic in stored}
    wrong: list[str] = []
    for stream in streams:
        found = held.get(stream.plan.target)
        rows = found.rows if found else 0
        if failure is not None:
            _take_back(stream, stream.rows - rows, f"not written before the run ended: {failure}", observe)
        elif (stream.rows, stream.start_ns, stream.end_ns) != _held(found):
            wrong.append(
                f"{stream.plan.target}: wrote {stream.rows} rows in [{stream.start_ns}, {stream.end_ns}], "
                f"found {'{} rows in [{}, {}]'.format(*_held(found))}"
            )
        observe(
            TopicClosed(
                stream.plan.target,
                stream.status,
                found.stored_bytes if found else 0,
                stream.error,
                stream.timeline.report(),
                found.checksum if found else None,
            )
        )
    return wrong


def _held(found: StoredTopic | None) -> tuple[int, int | None, int | None]:
    return (found.rows, found.start_ns, found.end_ns) if found else (0, None, None)


def _take_back(stream: Stream, rows: int, why: str, observe: Observer) -> None:
    """Count rows that were handed over but are not there as rejected."""
    if rows > 0:
        observe(TopicProgress(stream.plan.target, written=-rows))
        observe(Rejected(stream.plan.target, Stage.WRITE, "not-written", rows, why, stream.start_ns or 0, -1))


_log = logging.getLogger(__name__)

EXIT_REJECTED = 4
"""Everything that could be ingested was, but some messages could not."""


def resolver_for(config: ROSInjectionConfig) -> TypeResolver:
    """Return where definitions are looked for: the run's own, the registry, the distro."""
    custom = [(package, Path(path), store) for package, path, store in config.custom_msgs]
    return TypeResolver(config.ros_distro, custom, registry=config.registry or ROSTypeRegistry)


@contextmanager
def open_for(config: ROSInjectionConfig) -> Generator[tuple[Recording, TypeResolver]]:
    """Open the recording a configuration names."""
    resolver = resolver_for(config)
    with open_recording(config.paths, resolve=resolver) as recording:
        yield recording, resolver


def make_plan(config: ROSInjectionConfig) -> Plan:
    """Open the recording, decide everything, write nothing."""
    with _planned(config) as (plan, _):
        return plan


@contextmanager
def _planned(config: ROSInjectionConfig) -> Generator[tuple[Plan, Recording]]:
    with open_for(config) as (recording, resolver):
        yield resolve(config, recording, bridge=ROSBridge.for_config(config), resolver=resolver), recording


def preflight(plan: Plan) -> Finding | None:
    """Return a warning if the destination would not let the run follow its session error policy."""
    return destination_of(plan.target).preflight(plan.sequence, plan.on_error)


def execute(
    plan: Plan,
    observe: Observer,
    *,
    sink: Sink | None = None,
    recording: Recording | None = None,
    watch: Stopwatch | None = None,
) -> tuple[Report, IngestError | None]:
    """Run a plan; return what happened, and the error that ended it, if one did.

    `sink` stands in for the plan's target where the caller has its own, `recording` is open still from the planning,
    and `watch` knows when that began.
    """
    failure: IngestError | None = None
    watch = watch or Stopwatch()
    collector = Collector(watch)

    def tell(event: Event) -> None:
        collector(event)
        observe(event)

    tell(_started(plan))
    for finding in plan.findings:
        tell(Noted(finding))
    try:
        warning = None if sink else preflight(plan)
        if warning is not None:
            tell(Noted(warning))
        entered = plan if sink else enter(plan)
        if entered is None:
            tell(RunFinished(RunStatus.SKIPPED, 0))
            return collector.report(), None
        for path in plan.missing:
            tell(Unreadable(None, None, None, f"{path}: this part is not there"))
        for lost in _undefined(plan):
            tell(lost)
        with _opened(plan, recording) as source:
            destination = sink or destination_of(plan.target).open_sink(buffer_bytes=plan.memory_bytes // 4)
            watch.lap(Step.PREPARE)
            inject(entered, source, destination, tell, watch)
    except IngestError as error:
        failure = error
    watch.lap(Step.COMMIT)
    tell(Timed(watch.seconds))
    tell(_failed(failure) if failure else _done(collector))
    return collector.report(), failure


def _opened(plan: Plan, recording: Recording | None) -> AbstractContextManager[Recording]:
    if recording is not None:
        return nullcontext(recording)
    return open_recording(plan.files, resolve=plan.resolver)


def run_config(config: ROSInjectionConfig, observe: Observer) -> Report:
    """Plan and run one configuration; every outcome is a report, a mistake of ours and an interrupt too."""
    watch = Stopwatch()
    try:
        with _planned(config) as (plan, recording):
            report, _ = execute(plan, observe, recording=recording, watch=watch)
    except IngestError as error:
        return failed_report(config, error, observe)
    except KeyboardInterrupt:
        stopped = Interrupted("stopped before the recording was opened", where=str(config.paths[0]))
        return failed_report(config, stopped, observe)
    except Exception as error:  # noqa: BLE001 - the border: whatever one recording brings up, the next is still run
        _log.debug("unexpected", exc_info=True)
        return failed_report(config, _unexpected(config, error), observe)
    return report


def dry_run_report(plan: Plan, observe: Observer) -> Report:
    """Return the report of a plan that is not run: its topics and findings, no messages, status `skipped`."""
    collector = Collector()
    noted = (Noted(finding) for finding in plan.findings)
    for event in (_started(plan), *noted, RunFinished(RunStatus.SKIPPED, 0)):
        collector(event)
        observe(event)
    return collector.report()


def failed_report(config: ROSInjectionConfig, error: IngestError, observe: Observer) -> Report:
    """Return the report of a recording of which nothing was done."""
    collector = Collector()
    for event in (_unplanned(config), _failed(error)):
        collector(event)
        observe(event)
    return collector.report()


def _unexpected(config: ROSInjectionConfig, error: Exception) -> IngestError:
    said = str(error).strip().partition("\n")[0]
    return IngestError(
        f"unexpected {type(error).__name__}: {said}" if said else f"unexpected {type(error).__name__}",
        where=str(config.paths[0]),
        hint="this is a mistake in the program or in an adapter; `--log debug` shows where",
    )


def _started(plan: Plan) -> RunStarted:
    taken = (
        Expected(t.topic, t.target, t.msgtype, t.adapter.name, t.ontology.tag, t.why, t.count)
        for t in plan.topics
    )
    left = (
        Expected(t.topic, t.topic, t.msgtype, "", "", t.why, t.count, excluded=True) for t in plan.excluded
    )
    return RunStarted(
        sequence=plan.sequence,
        destination=destination_of(plan.target).describe(),
        files=tuple(str(path) for path in plan.files),
        source_bytes=plan.source_bytes,
        topics=(*taken, *left),
    )


def _undefined(plan: Plan) -> Iterator[Unreadable]:
    """Yield what is lost for want of a definition; how much that is of a stretch of time, the index does not say."""
    taken = {topic.target for topic in plan.topics}
    whole = plan.read_from_ns is None and plan.read_until_ns is None
    for topic in plan.excluded:
        if topic.undefined:
            target = None if topic.topic in taken else topic.topic
            reason = f"no definition of {topic.msgtype} can be used"
            yield Unreadable(target, topic.count if whole else None, None, reason)


def _unplanned(config: ROSInjectionConfig) -> RunStarted:
    return RunStarted(
        sequence=config.sequence_name,
        destination=destination_of(config.target).describe(),
        files=tuple(str(path) for path in config.paths),
        source_bytes=0,
        topics=(),
    )


def _failed(error: IngestError) -> RunFinished:
    status = RunStatus.INTERRUPTED if isinstance(error, Interrupted) else RunStatus.FAILED
    return RunFinished(status, error.exit_code, str(error), error.findings)


def _done(collector: Collector) -> RunFinished:
    if collector.rejected or collector.unreadable:
        return RunFinished(RunStatus.REJECTED, EXIT_REJECTED)
    return RunFinished(RunStatus.COMPLETED, 0)
