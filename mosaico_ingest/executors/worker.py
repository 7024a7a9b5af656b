"""This file is the composition root: it turns a configuration into a plan, and a plan's target into a sink."""

from __future__ import annotations

import logging
from collections.abc import Generator, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from os.path import normpath
from pathlib import Path

from mosaico_ingest.bag.recording import Recording, open_recording
from mosaico_ingest.bag.registry import ROSTypeRegistry
from mosaico_ingest.bag.types import TypeResolver
from mosaico_ingest.bridge import ROSBridge
from mosaico_ingest.config import ROSInjectionConfig, ServerTarget, StoreTarget
from mosaico_ingest.diagnostics import Finding
from mosaico_ingest.errors import IngestError, Interrupted
from mosaico_ingest.executors.ledger import enter
from mosaico_ingest.injector import inject
from mosaico_ingest.plan.model import Plan
from mosaico_ingest.plan.resolve import resolve
from mosaico_ingest.policies import SessionLevelErrorPolicy
from mosaico_ingest.remote.path import RemotePath
from mosaico_ingest.report.collect import Collector
from mosaico_ingest.report.events import (
    Event,
    Expected,
    Noted,
    Observer,
    RunFinished,
    RunStarted,
    RunStatus,
    Timed,
    Unreadable,
)
from mosaico_ingest.report.model import Report
from mosaico_ingest.report.stopwatch import Step, Stopwatch
from mosaico_ingest.sink import Sink
from mosaico_ingest.store.sink import StoreSink
from mosaico_ingest.store.store import Store

__all__ = ["execute", "failed_report", "make_plan", "open_for", "preflight", "run_config", "sink_for"]

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


def sink_for(target: StoreTarget | ServerTarget, *, buffer_bytes: int) -> Sink:
    """Turn a target into the object that writes there and holds at most about `buffer_bytes` in memory."""
    if isinstance(target, StoreTarget):
        return StoreSink(Store.open(target.path), buffer_bytes)
    from mosaico_ingest.platform.sink import PlatformSink  # noqa: PLC0415 - Flight is slow to import and rarely needed

    return PlatformSink(target, buffer_bytes)


def preflight(plan: Plan) -> Finding | None:
    """Return what a server's key would not let the session policy do; the server is asked."""
    if not isinstance(plan.target, ServerTarget) or plan.on_error is not SessionLevelErrorPolicy.Delete:
        return None
    from mosaico_ingest.platform.preflight import delete_finding  # noqa: PLC0415 - as in sink_for

    return delete_finding(plan.target, plan.sequence)


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
            destination = sink or sink_for(plan.target, buffer_bytes=plan.memory_bytes // 4)
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
        Expected(t.topic, t.topic, t.msgtype, "", "", t.why, t.count, left_out=True) for t in plan.left_out
    )
    return RunStarted(
        sequence=plan.sequence,
        destination=place(plan.target),
        files=tuple(str(path) for path in plan.files),
        source_bytes=plan.source_bytes,
        topics=(*taken, *left),
    )


def _undefined(plan: Plan) -> Iterator[Unreadable]:
    """Yield what is lost for want of a definition; how much that is of a stretch of time, the index does not say."""
    taken = {topic.target for topic in plan.topics}
    whole = plan.read_from_ns is None and plan.read_until_ns is None
    for topic in plan.left_out:
        if topic.lost:
            target = None if topic.topic in taken else topic.topic
            reason = f"no definition of {topic.msgtype} can be used"
            yield Unreadable(target, topic.count if whole else None, None, reason)


def _unplanned(config: ROSInjectionConfig) -> RunStarted:
    return RunStarted(
        sequence=config.sequence_name,
        destination=place(config.target),
        files=tuple(str(path) for path in config.paths),
        source_bytes=0,
        topics=(),
    )


def place(target: StoreTarget | ServerTarget) -> str:
    """Return a target as people write it, without its key."""
    if isinstance(target, ServerTarget):
        return f"{target.host}:{target.port}"
    return str(target.path) if isinstance(target.path, RemotePath) else normpath(target.path)


def _failed(error: IngestError) -> RunFinished:
    status = RunStatus.INTERRUPTED if isinstance(error, Interrupted) else RunStatus.FAILED
    return RunFinished(status, error.exit_code, str(error), error.findings)


def _done(collector: Collector) -> RunFinished:
    if collector.rejected or collector.unreadable:
        return RunFinished(RunStatus.REJECTED, EXIT_REJECTED)
    return RunFinished(RunStatus.COMPLETED, 0)
