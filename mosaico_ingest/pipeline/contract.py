"""The data contract of a run: the observation of its messages, their check without a run, and the decision about the commit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import pyarrow as pa
from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.bridge import ROSBridge
from mosaico_ingest.contracts import TIME_KEYS, Contract
from mosaico_ingest.contracts.monitor import BlockObserver, RecordingMonitor, summary
from mosaico_ingest.decode.decoder import decoder_for
from mosaico_ingest.destinations import AmendableSession, Session, destination_of
from mosaico_ingest.errors import AdapterError, ContractError
from mosaico_ingest.findings import Severity
from mosaico_ingest.job.values import PROVENANCE_KEY, OnFailure
from mosaico_ingest.pipeline.contract_check import WHOLE_FILE_KEYS, add_times
from mosaico_ingest.pipeline.plan import Plan, TopicPlan, observed_topics
from mosaico_ingest.pipeline.planning import plan_recording
from mosaico_ingest.pipeline.provenance import SequenceRequest
from mosaico_ingest.pipeline.selection import bind_conditions, row_selector, row_times
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.pipeline.topic import TopicPipeline, pipelines_by_connection
from mosaico_ingest.report.events import ContractEvaluated, Noted, Observer
from mosaico_ingest.report.parts import ContractResult, ExpectationResult, Outcome
from mosaico_ingest.rosbag.blocks import Connection, Int64s, MessageBlock
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.recording import Recording

DIVERTED = "{name}__failed"
"""The name of a diverted sequence."""
_KEY = "contract"
"""The key of the results in the provenance of a sequence."""
_INDEX_KEYS = frozenset({"duration", "start", "end", "messages", "metadata_counts"})
"""Expectations of the recording that the index decides."""
_SAMPLE_KEYS = frozenset(
    {"latency", "stamps", "frame_id", "between", "min", "max", "finite", "equals", "one_of"}
)
"""Expectations of rows that a few messages can violate."""


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
    findings = tuple(finding for error in result.errors if (finding := error.finding) is not None)
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
    for each in result.results:
        finding = each.finding
        if finding is None or each in errors or finding.rule == "expectation-skipped":
            continue
        if finding.severity is Severity.ERROR:
            finding = replace(finding, severity=Severity.WARNING)
        observe(Noted(finding))


def check_messages(task: Task, recording: Recording, resolver: TypeResolver) -> ContractResult:
    """Return the results of a job's contract; see `contract_check.check_contract`."""
    plan = plan_recording(task, recording, bridge=ROSBridge.for_job(task.job), resolver=resolver)
    monitor = monitor_of(plan, recording)
    if monitor is None or plan.contract is None:
        raise AssertionError
    _observe(plan, plan.contract, recording, monitor)
    return monitor.finish()


def index_results(plan: Plan, recording: Recording) -> list[ExpectationResult]:
    """Return the results that the index of the recording decides; no message is read."""
    monitor = monitor_of(plan, recording)
    if monitor is None:
        return []
    topics = tuple(key for topic in plan.read_topics for key in topic.connections)
    observed = [key for key in topics if monitor.observer(key) is not None]
    times = None
    if not recording.is_remote:  # the times of a remote file cost a request per chunk
        times = recording.index_times(observed, start_ns=plan.read_from_ns, end_ns=plan.read_until_ns)
    if times is None:
        monitor = monitor_of(plan.replace(topics=()), recording)
    else:
        add_times(monitor, times)
    results = () if monitor is None else monitor.finish().results
    outputs = {topic.target for topic in plan.topics if topic.output}
    return [
        result
        for result in results
        if result.topic not in outputs and _is_known(result, has_times=times is not None)
    ]


def sample_results(monitor: RecordingMonitor) -> list[ExpectationResult]:
    """Return the expectations that some of the messages that a monitor observed violate."""
    return [
        result
        for result in monitor.finish().results
        if result.outcome is Outcome.FAILED
        and result.topic is not None
        and result.key.rpartition(".")[2] in _SAMPLE_KEYS
    ]


def _is_known(result: ExpectationResult, *, has_times: bool) -> bool:
    if result.outcome is Outcome.SKIPPED:
        return False
    if result.topic is None:
        return result.key in _INDEX_KEYS or not result.expectation.startswith("expect.recording.")
    return result.key == "type" or (result.key in TIME_KEYS and (has_times or result.key == "messages"))


def _observe(plan: Plan, contract: Contract, recording: Recording, monitor: RecordingMonitor) -> None:
    """Observe every message for which something is expected, through the index where that is enough."""
    topics = {key: topic for topic in plan.read_topics for key in topic.connections}
    observers = {key: monitor.observer(key) for key in topics}
    reads_all = any(clause.key in WHOLE_FILE_KEYS for clause in contract.recording_clauses())
    if not reads_all:
        observers = {key: observer for key, observer in observers.items() if observer is not None}
    timed = [key for key, observer in observers.items() if observer is None or not observer.needs_rows]
    if reads_all or monitor.order is not None:
        timed = []
    times = (
        recording.index_times(timed, start_ns=plan.read_from_ns, end_ns=plan.read_until_ns) if timed else {}
    )
    if times is not None:
        add_times(monitor, times)
    read = [key for key in observers if times is None or key not in times]
    if not read:
        return
    connections = {connection.id: connection for connection in recording.connections}
    rows = {
        key: _Rows(plan, topics[key], connections[key], observer, monitor)
        for key in read
        if (observer := observers[key]) is not None
    }
    order = monitor.order
    blocks = recording.message_blocks(
        tuple(read),
        start_ns=plan.read_from_ns,
        end_ns=plan.read_until_ns,
        observe=None if order is None else order.add,
    )
    for block in blocks:
        if block.connection in rows:
            rows[block.connection].add(block)


class _Rows:
    """Decodes and adapts the blocks of one connection, as far as an expectation needs it."""

    def __init__(
        self,
        plan: Plan,
        topic: TopicPlan,
        connection: Connection,
        observer: BlockObserver,
        monitor: RecordingMonitor,
    ) -> None:
        self._topic = topic
        self._connection = connection
        self._observer = observer
        self._monitor = monitor
        self._read = 0
        rows = observer.rows
        self._adapts = bool(observer.outputs) or (rows is not None and rows.needs_ontology)
        self._decodes = self._adapts or rows is not None
        self._decoder = decoder_for(connection) if self._decodes else None
        definition = connection.definition
        self._adapter = (
            topic.adapter.bind(definition, ros_shape(definition))
            if self._adapts and definition is not None
            else None
        )
        self._selector = row_selector(plan, topic)
        self._conditions = (
            bind_conditions(topic, definition) if topic.has_conditions and definition is not None else None
        )
        if self._adapts:
            monitor.reject(topic.topic, 0)

    def add(self, block: MessageBlock) -> None:
        """Add a block."""
        self._observer.block(block.log_times)
        positions = np.arange(len(block), dtype=np.int64)
        sample = positions[(positions + self._read) % self._topic.every == 0]
        self._read += len(block)
        if self._decoder is None:
            return
        decoded = self._decoder.decode(block if len(sample) == len(block) else block.rows(sample))
        rows, index = self._selected(block, decoded.rows, sample[decoded.index])
        self._observer.messages(rows, index)
        rejected = len(decoded.failures)
        if self._adapter is not None:
            try:
                adapted = self._adapter.adapt(rows, self._envelope(block, index))
            except AdapterError:
                rejected += len(index)
            else:
                self._observer.adapted(adapted, index)
                rejected += len(adapted.failures)
            self._monitor.reject(self._topic.topic, rejected)

    def _envelope(self, block: MessageBlock, index: Int64s) -> Envelope:
        """Return the envelope of some messages of a block."""
        topic = self._topic
        return Envelope(
            topic.topic, topic.msgtype, block.log_times, block.publish_times, block.sequences
        ).take(index)

    def _selected(
        self, block: MessageBlock, rows: pa.StructArray, index: Int64s
    ) -> tuple[pa.StructArray, Int64s]:
        """Return the rows that the settings of the topic keep, and their positions in the block."""
        if self._selector is None:
            return rows, index
        log_times = block.log_times[index]
        publish_times = None if block.publish_times is None else block.publish_times[index]
        topic = self._topic
        times = row_times(topic.stamp, topic.time_offset_ns, rows, log_times, publish_times)
        envelope = self._envelope(block, index)
        keep, _ = self._selector.select(times.values, rows, envelope, self._conditions)
        return (rows, index) if keep is None else (rows.filter(pa.array(keep)), index[keep])
