"""The data contract of a run: it observes the messages while they are ingested, and decides about the commit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.contracts.monitor import RecordingMonitor, summary
from mosaico_ingest.contracts.times import FileOrder
from mosaico_ingest.destinations.base import AmendableSession, Session, destination_of
from mosaico_ingest.errors import ContractError
from mosaico_ingest.findings import Severity
from mosaico_ingest.job.values import PROVENANCE_KEY, OnFailure
from mosaico_ingest.pipeline.plan import Plan, observed_topics
from mosaico_ingest.pipeline.provenance import SequenceRequest
from mosaico_ingest.pipeline.topic import TopicPipeline, pipelines_by_connection
from mosaico_ingest.report.contract import ContractResult
from mosaico_ingest.report.events import ContractEvaluated, Noted, Observer
from mosaico_ingest.rosbag.blocks import MessageBlock
from mosaico_ingest.rosbag.recording import Recording

DIVERTED = "{name}__failed"
"""The name of a diverted sequence."""
_KEY = "contract"
"""The key of the results in the provenance of a sequence."""


class ContractRun(Struct, frozen=True):
    """The contract of one run."""

    plan: Plan
    monitor: RecordingMonitor
    topics: tuple[TopicPipeline, ...]

    @classmethod
    def start(cls, plan: Plan, recording: Recording, topics: Sequence[TopicPipeline]) -> ContractRun | None:
        """Attach the monitors of a contract to the topics; return None without a contract."""
        monitor = monitor_of(plan, recording)
        if monitor is None:
            return None
        attach_monitor(monitor, pipelines_by_connection(topics))
        return cls(plan, monitor, tuple(topic for topic in topics if not topic.plan.shares_messages))

    @property
    def order(self) -> FileOrder | None:
        """The observer of the order in the files, if an expectation needs it."""
        return self.monitor.order

    def observe_order(self, split: int, connection: int, block: MessageBlock) -> None:
        """Observe the messages of the time range in the order of the files."""
        if self.monitor.order is None:
            return
        if self.plan.selects_after_reading:
            inside = np.ones(len(block), bool)
            if self.plan.read_from_ns is not None:
                inside &= block.log_times >= self.plan.read_from_ns
            if self.plan.read_until_ns is not None:
                inside &= block.log_times < self.plan.read_until_ns
            block = block.rows(inside)
        if len(block):
            self.monitor.order.add(split, connection, block)

    def conclude(self, request: SequenceRequest, session: Session, observe: Observer) -> None:
        """Evaluate the contract, report the results, and add them to the metadata of the sequence.

        Raises:
            ContractError: The contract is violated, and nothing may be committed.
        """
        for topic in self.topics:
            self.monitor.reject(topic.plan.topic, topic.read - topic.written - topic.dropped)
        result = self.monitor.finish()
        action = self.monitor.on_failure
        diverts = action is OnFailure.DIVERT and not result.passed
        can_amend = destination_of(self.plan.destination).can_amend
        if diverts and can_amend:
            result = result.replace(stored_as=DIVERTED.format(name=request.name))
        observe(ContractEvaluated(result))
        _report(result, observe, as_warnings=action is not OnFailure.FAIL)
        if not result.passed and (action is OnFailure.FAIL or (diverts and not can_amend)):
            raise contract_error(result)
        if can_amend:
            record: dict[str, Any] = {**request.metadata[PROVENANCE_KEY], _KEY: summary(result)}
            metadata = {**request.metadata, PROVENANCE_KEY: record}
            cast("AmendableSession", session).amend(metadata, sequence=result.stored_as)


def monitor_of(plan: Plan, recording: Recording) -> RecordingMonitor | None:
    """Return the monitor of a plan's contract, or None without a contract."""
    if plan.contract is None:
        return None
    return RecordingMonitor(
        plan.contract,
        recording,
        observed_topics(plan.topics),
        excluded={topic.topic: topic.why for topic in plan.excluded},
        start_ns=plan.read_from_ns,
        end_ns=plan.read_until_ns,
    )


def attach_monitor(monitor: RecordingMonitor, pipelines: Mapping[int, TopicPipeline]) -> None:
    """Let a monitor observe the messages of the pipelines, which are given by connection."""
    for connection, topic in pipelines.items():
        observer = monitor.observer(connection)
        if observer is not None:
            topic.observers[connection] = observer


def check_group(plan: Plan) -> None:
    """Check the expectations of the group that a recording belongs to, before it is read.

    Raises:
        ContractError: An expectation failed, and nothing may be committed.
    """
    contract = plan.contract
    if contract is None or contract.expect.on_failure is not OnFailure.FAIL:
        return
    result = ContractResult(on_failure=OnFailure.FAIL.value, results=contract.group)
    if not result.passed:
        raise contract_error(result)


def contract_error(result: ContractResult) -> ContractError:
    """Return the error for a violated contract."""
    findings = tuple(finding for one in result.errors if (finding := one.finding) is not None)
    first = findings[0]
    count = len(findings)
    text = first.message if count == 1 else f"{count} expectations failed; the first: {first.message}"
    return ContractError(
        text,
        where=None if first.span is None else str(first.span),
        hint="nothing was written; set expect.on_failure to warn or divert to keep such a recording",
        findings=findings,
    )


def _report(result: ContractResult, observe: Observer, *, as_warnings: bool) -> None:
    """Report failed expectations, and those whose violations are explained."""
    errors = set() if as_warnings else set(result.errors)
    for one in result.results:
        finding = one.finding
        if finding is None or one in errors or finding.rule == "expectation-skipped":
            continue
        if finding.severity is Severity.ERROR:
            finding = replace(finding, severity=Severity.WARNING)
        observe(Noted(finding))
