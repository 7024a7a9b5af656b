"""This file makes a recording's plan to look at: decided as for a run, tried on a few messages, nothing written."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from os.path import relpath
from pathlib import Path

from mosaico_ingest.bag.recording import Recording
from mosaico_ingest.bridge import ROSBridge
from mosaico_ingest.config import ROSInjectionConfig
from mosaico_ingest.diagnostics import Finding, Severity
from mosaico_ingest.errors import IngestError
from mosaico_ingest.executors.trial import try_messages
from mosaico_ingest.executors.worker import open_for, preflight
from mosaico_ingest.patterns import first_match
from mosaico_ingest.plan.describe import decisions, notes
from mosaico_ingest.plan.destination import ask_destination, space_finding
from mosaico_ingest.plan.document import Decisions, PlanDocument, RecordingPlan
from mosaico_ingest.plan.model import Plan
from mosaico_ingest.plan.resolve import resolve
from mosaico_ingest.version import __version__

__all__ = ["decide", "plan_document", "preview"]


def plan_document(
    configs: Sequence[ROSInjectionConfig], *, job: Path, folder: Path, connect: bool
) -> PlanDocument:
    """Return what a manifest's configurations would do, as a document for `folder`.

    Raises:
        IngestError: One of them cannot be done; of several that cannot, `findings` says why of each.
    """
    tried = [_tried(config, connect=connect) for config in configs]
    planned = tuple(one for one in tried if isinstance(one, RecordingPlan))
    refused = [one for one in tried if isinstance(one, IngestError)]
    if refused:
        raise refused[0] if len(tried) == 1 else _all_of(refused, len(tried))
    return PlanDocument(
        tool=f"mosaico-ingest {__version__}",
        job=Path(relpath(job, folder)).as_posix(),
        recordings=planned,
    )


def _tried(config: ROSInjectionConfig, *, connect: bool) -> RecordingPlan | IngestError:
    try:
        return preview(config, connect=connect)
    except IngestError as error:
        return error


def _all_of(refused: Sequence[IngestError], count: int) -> IngestError:
    """Return one error for all of them, with the exit code that is the least."""
    findings = [
        finding
        for error in refused
        for finding in error.findings or (Finding("refused", Severity.ERROR, str(error)),)
    ]
    one = min(refused, key=lambda error: error.exit_code)
    one.what, one.where, one.hint = f"{len(refused)} of {count} recordings cannot be ingested", None, None
    one.findings = tuple(dict.fromkeys(findings))
    return one


def preview(config: ROSInjectionConfig, *, connect: bool) -> RecordingPlan:
    """Open the recording, decide everything, try a few messages, ask the destination (a server only with `connect`).

    Raises:
        IngestError: The job cannot be done; the message says why.
    """
    bridge = ROSBridge.for_config(config)
    with open_for(config) as (recording, resolver):
        plan = resolve(config, recording, bridge=bridge, resolver=resolver)
        samples = try_messages(plan, recording)
        losses = tuple(_losses(recording))
    decided = decisions(plan, folder=config.base_dir)
    state = ask_destination(plan, samples, connect=connect)
    warning = preflight(plan) if connect and state.exists else None
    found = (finding for finding in (space_finding(state), warning) if finding is not None)
    return RecordingPlan(
        digest=decided.digest,
        decisions=decided,
        destination=state,
        samples=samples,
        notes=notes((*plan.findings, *losses, *_chosen(config, plan), *_left_out(plan), *found)),
    )


def decide(config: ROSInjectionConfig, *, folder: Path) -> Decisions:
    """Open the recording and decide everything; paths are seen from `folder`.

    Raises:
        IngestError: The job cannot be done; the message says why.
    """
    bridge = ROSBridge.for_config(config)
    with open_for(config) as (recording, resolver):
        return decisions(resolve(config, recording, bridge=bridge, resolver=resolver), folder=folder)


def _losses(recording: Recording) -> Iterator[Finding]:
    for loss in recording.losses:
        where = f"{Path(loss.file).name} at {loss.offset}" if loss.file else "the recording"
        yield Finding("unreadable", Severity.WARNING, f"{where}: {loss.reason}")


def _chosen(config: ROSInjectionConfig, plan: Plan) -> Iterator[Finding]:
    """Yield a note for each topic whose adapter the manifest names, with the line that does."""
    for topic in plan.topics:
        glob = first_match(config.adapter_override, topic.topic)
        if glob is not None:
            place = config.places.get(("adapters", "override", glob))
            yield Finding(
                "override", Severity.INFO, f"{topic.topic}: {topic.adapter.name} by {glob!r}", place
            )


def _left_out(plan: Plan) -> Iterator[Finding]:
    """Yield a note for each topic that is not read, with the line of the manifest that says so."""
    for topic in plan.left_out:
        severity = Severity.WARNING if topic.lost else Severity.INFO
        yield Finding("left-out", severity, f"{topic.topic}: {topic.why}", topic.span)
