"""The run of one recording: open, plan, check provenance, open the sink, pump, verify, report."""

from __future__ import annotations

import logging
import time
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial

from msgspec import Struct

from mosaico_ingest.adapters.bridge import ROSBridge
from mosaico_ingest.destinations import Sink, destination_of
from mosaico_ingest.errors import ContractError, IngestError, Interrupted
from mosaico_ingest.findings import Finding
from mosaico_ingest.interrupts import DeferredInterrupt
from mosaico_ingest.job.model import Job
from mosaico_ingest.job.values import LoaderErrorPolicy
from mosaico_ingest.pipeline.plan import Plan
from mosaico_ingest.pipeline.planning import plan_recording
from mosaico_ingest.pipeline.provenance import check_provenance, fingerprint, is_fingerprinted
from mosaico_ingest.pipeline.pump import Written, verify, write_sequence
from mosaico_ingest.pipeline.rejections import RejectionLog
from mosaico_ingest.pipeline.task import Task, open_job
from mosaico_ingest.report.events import (
    BatchObserver,
    Event,
    Expected,
    Noted,
    Observer,
    RunFinished,
    RunStarted,
    RunStatus,
    Timed,
    Unreadable,
    ignore_events,
    log_level,
)
from mosaico_ingest.report.parts import ContractResult, Step, Stopwatch
from mosaico_ingest.report.recording import Collector, Report
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.recording import Recording

_log = logging.getLogger(__name__)

EXIT_WITH_ERRORS = 4
"""The exit code of a completed run with rejected rows or unreadable ranges."""


class Outcome(Struct, frozen=True):
    """The report of a run, and the error that ended it."""

    report: Report
    error: IngestError | None = None


def run_recording(task: Task, observe: Observer = ignore_events) -> Outcome:
    """Ingest or plan one recording; see `run_group`."""
    (outcome,) = run_group([task], lambda _position, event: observe(event))
    return outcome


def run_group(tasks: Iterable[Task], observe: BatchObserver) -> list[Outcome]:
    """Ingest recordings one after the other and commit them together, or plan those whose task is a dry run.

    All tasks have the same target. Every error, expected or not, is part of the outcome of its recording. An interrupt
    ends the group: its later recordings do not start and have no outcome.

    Only errors of the observer are raised; sessions that are not committed are then discarded.
    """
    runs: list[_Run] = []
    with DeferredInterrupt() as interrupt:
        try:
            for position, task in enumerate(tasks):
                if interrupt.asked:
                    break
                run = _Run(task, partial(observe, position))
                runs.append(run)
                run.write(interrupt)
                if run.is_interrupted:
                    break
                if any(each.written for each in runs):
                    interrupt.defer()  # a signal between two recordings waits for the commit
            _commit(runs)
        except BaseException:
            _discard(runs)
            raise
    last = next((run for run in reversed(runs) if run.written is not None), None)
    return [run.finish(interrupted=interrupt.asked and run is last) for run in runs]


class _Run:
    """The run of one recording in two steps: `write` until its session ends, and `finish` after the commit."""

    def __init__(self, task: Task, observe: Observer) -> None:
        self.task = task
        self.written: Written | None = None
        """The session to commit; None if there is none."""
        self.commit_error: Exception | None = None
        self.commit_s = 0.0
        """The share of this run in the time of the commit."""
        self._events = _RunEvents(task, observe)
        self._outcome: Outcome | None = None

    @property
    def is_interrupted(self) -> bool:
        """Whether a signal ended the reading."""
        error = self._outcome.error if self._outcome else self.written and self.written.failure
        return isinstance(error, Interrupted)

    def write(self, interrupt: DeferredInterrupt) -> None:
        """Run the task up to the end of its session."""
        with self._errors_reported():
            interrupt.allow()
            self.written = _ingest(self.task, self._events, interrupt)
            if self.written is None:
                self._outcome = self._events.skip()
        self._events.stopwatch.pause()

    def finish(self, *, interrupted: bool) -> Outcome:
        """Check the committed rows, and return the outcome.

        `interrupted` is true if a signal arrived before or during the commit, which was finished first. The outcome is then
        that of an interrupt even if there was an error, so that no other recording starts.
        """
        self._events.stopwatch.resume(self.commit_s)
        if self.written is not None:
            with self._errors_reported(), log_level(self.task.job.run.log_level):
                try:
                    verify(self.written, self.commit_error, self._events)
                except Exception as error:
                    if not interrupted or isinstance(error, Interrupted):
                        raise
                    raise Interrupted(f"stopped by a signal, after an error: {error}") from error
                if interrupted:
                    raise Interrupted("stopped after the recording was stored completely")
                self._outcome = self._events.complete()
        assert self._outcome is not None  # noqa: S101 - both steps report every error
        return self._outcome

    @contextmanager
    def _errors_reported(self) -> Generator[None]:
        """Turn every error inside into the outcome of the run."""
        job, events = self.task.job, self._events
        try:
            yield
        except IngestError as error:
            self._outcome = events.fail(error)
        except KeyboardInterrupt:
            where = str(job.paths[0])
            self._outcome = events.fail(Interrupted("stopped before any message was read", where=where))
        except Exception as error:  # noqa: BLE001 - one recording must not end the run of the others
            _log.debug("unexpected", exc_info=True)
            self._outcome = events.fail(_unexpected(job, error))


def _commit(runs: Sequence[_Run]) -> None:
    """Commit the sessions of the runs together."""
    written = [(run, run.written.session) for run in runs if run.written is not None]
    if not written:
        return
    start_s = time.perf_counter()
    destination = destination_of(runs[0].task.job.destination)
    sessions = [session for _, session in written]
    try:
        errors = destination.commit(sessions)
    except KeyboardInterrupt:  # the second signal, since the first one is deferred
        destination.discard(sessions)
        errors = [Interrupted("stopped during the commit", hint="run the same command again")] * len(sessions)
    elapsed_s = time.perf_counter() - start_s
    for (run, _), error in zip(written, errors, strict=True):
        run.commit_error, run.commit_s = error, elapsed_s / len(written)


def _discard(runs: Sequence[_Run]) -> None:
    """Discard the sessions of the runs, unless they are committed."""
    sessions = [run.written.session for run in runs if run.written is not None]
    if sessions:
        destination_of(runs[0].task.job.destination).discard(sessions)


def _ingest(task: Task, events: _RunEvents, interrupt: DeferredInterrupt) -> Written | None:
    """Run a task up to the end of its session; return None if there is nothing to write."""
    job = task.job
    if task.known:
        events.start_unopened()
        return None
    before = None if task.dry_run else fingerprint(job)
    with log_level(job.run.log_level), open_job(job) as (recording, resolver):
        plan = _plan(task, recording, resolver)
        events.start(plan)
        if task.dry_run:
            return None
        _check_group(plan)
        request = check_provenance(plan, before if is_fingerprinted(job, plan.files) else None)
        if request is None:
            return None
        sink = _open_sink(plan, events)
        events.stopwatch.lap(Step.PREPARE)
        return write_sequence(
            plan, request, recording, sink, observe=events, stopwatch=events.stopwatch, interrupt=interrupt
        )


def _check_group(plan: Plan) -> None:
    """Raise ContractError if an expectation about the group of the recording failed, and nothing may be committed."""
    if plan.contract is not None:
        from mosaico_ingest.pipeline.contract import check_group  # noqa: PLC0415 - only contracts need it

        check_group(plan)


def make_plan(task: Task) -> Plan:
    """Open the recording of a task and decide everything, without writing.

    Raises:
        IngestError: The job does not fit the recording.
    """
    with open_job(task.job) as (recording, resolver):
        return _plan(task, recording, resolver)


def preflight(plan: Plan) -> tuple[Finding, ...]:
    """Return the warnings of the destination about a run."""
    return destination_of(plan.destination).preflight(plan.sequence.name, plan.on_error.session)


def failed_report(task: Task, error: IngestError, observe: Observer) -> Report:
    """Return the report of a recording that was not started."""
    return _RunEvents(task, observe).fail(error).report


def _plan(task: Task, recording: Recording, resolver: TypeResolver) -> Plan:
    bridge = ROSBridge.for_job(task.job, folder=task.adapter_folder)
    return plan_recording(task, recording, bridge=bridge, resolver=resolver)


def _open_sink(plan: Plan, events: _RunEvents) -> Sink:
    """Open the destination, and report its warnings."""
    for warning in preflight(plan):
        events(Noted(warning))
    return destination_of(plan.destination).open_sink(buffer_bytes=plan.memory.sink_bytes)


def _diverted(contract: ContractResult) -> str:
    from mosaico_ingest.pipeline.contract import contract_error  # noqa: PLC0415 - only contracts need it

    error = contract_error(contract)
    return f"stored as {contract.stored_as}: {error.where}: {error.what}" if error.where else error.what


def _unexpected(job: Job, cause: Exception) -> IngestError:
    first_line = str(cause).strip().partition("\n")[0]
    name = type(cause).__name__
    error = IngestError(
        f"unexpected {name}: {first_line}" if first_line else f"unexpected {name}",
        where=str(job.paths[0]),
        hint="this is a bug in the program or in an adapter; run with `--log debug` for the traceback",
    )
    error.__cause__ = cause
    return error


class _RunEvents:
    """Passes the events of one run to its observer and collects them into the report."""

    def __init__(self, task: Task, observe: Observer) -> None:
        self.stopwatch = Stopwatch()
        self._task = task
        self._observe = observe
        self._log_rejection = ignore_events
        if task.job.on_error.message is LoaderErrorPolicy.LOG_WARN:
            self._log_rejection = RejectionLog(task.job.sequence.name)
        self._collector = Collector(self.stopwatch)
        self._started = False

    def __call__(self, event: Event) -> None:
        """Collect an event and pass it on."""
        self._collector(event)
        self._log_rejection(event)
        self._observe(event)

    def start(self, plan: Plan) -> None:
        """Report the plan, its findings, and the unreadable ranges that opening the recording found."""
        self._started = True
        self(_run_started(plan))
        for finding in plan.findings:
            self(Noted(finding))
        if not self._task.dry_run:
            for event in _unreadable_by_plan(plan):
                self(event)

    def skip(self) -> Outcome:
        """End a run that has nothing to write."""
        self(RunFinished(RunStatus.SKIPPED, 0))
        return Outcome(self._collector.report())

    def start_unopened(self) -> None:
        """Report the start of a recording that is not opened, so that its report has no topics."""
        self._started = True
        self(_not_planned(self._task.job))

    def complete(self) -> Outcome:
        """End a run that was committed and verified."""
        self._report_times()
        contract = self._collector.contract
        if contract is not None and contract.stored_as is not None:
            self(RunFinished(RunStatus.DIVERTED, ContractError.exit_code, _diverted(contract)))
        elif self._collector.rejected or self._collector.unreadable:
            self(RunFinished(RunStatus.WITH_ERRORS, EXIT_WITH_ERRORS))
        else:
            self(RunFinished(RunStatus.COMPLETED, 0))
        return Outcome(self._collector.report())

    def fail(self, error: IngestError) -> Outcome:
        """End a run with an error."""
        if self._started:
            self._report_times()
        else:
            self(_not_planned(self._task.job))
        status = RunStatus.INTERRUPTED if isinstance(error, Interrupted) else RunStatus.FAILED
        self(RunFinished(status, error.exit_code, str(error), error.findings))
        return Outcome(self._collector.report(), error)

    def _report_times(self) -> None:
        self.stopwatch.lap(Step.COMMIT)
        self(Timed(self.stopwatch.seconds))


def _run_started(plan: Plan) -> RunStarted:
    selected = (
        Expected(
            t.topic,
            t.target,
            t.msgtype,
            t.adapter.name,
            t.ontology.tag,
            t.why,
            t.count,
            shares_messages=t.shares_messages,
        )
        for t in plan.topics
    )
    excluded = (
        Expected(t.topic, t.topic, t.msgtype, "", "", t.why, t.count, excluded=True) for t in plan.excluded
    )
    return RunStarted(
        sequence=plan.sequence.name,
        destination=destination_of(plan.destination).describe(),
        files=tuple(str(path) for path in plan.files),
        source_bytes=plan.source_bytes,
        topics=(*selected, *excluded),
    )


def _not_planned(job: Job) -> RunStarted:
    return RunStarted(
        sequence=job.sequence.name,
        destination=destination_of(job.destination).describe(),
        files=tuple(str(path) for path in job.paths),
        source_bytes=0,
        topics=(),
    )


def _unreadable_by_plan(plan: Plan) -> Iterator[Unreadable]:
    """Yield missing splits, and selected topics without a definition.

    The index counts the messages of the complete recording only, so a time range leaves the number unknown.
    """
    for path in plan.missing:
        yield Unreadable(None, None, None, f"{path}: this split does not exist")
    targets = {topic.target for topic in plan.topics}
    complete = plan.read_from_ns is None and plan.read_until_ns is None
    for topic in plan.excluded:
        if topic.undefined:
            target = None if topic.topic in targets else topic.topic
            reason = f"no definition of {topic.msgtype} can be used"
            yield Unreadable(target, topic.count if complete else None, None, reason)
