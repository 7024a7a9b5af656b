"""The check of a stored sequence: its rows are observed in place of the messages of a recording."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.adapters.adapter import ROS_METADATA_KEY, Envelope
from mosaico_ingest.adapters.bridge import ROSBridge
from mosaico_ingest.adapters.inverse import Inverse, invert
from mosaico_ingest.adapters.mapping.columns import struct_of
from mosaico_ingest.adapters.mapping.expressions import FieldAccess, TypedExpression
from mosaico_ingest.contracts import Clause, Contract
from mosaico_ingest.contracts.evaluate import Facts, TopicFacts, evaluate
from mosaico_ingest.contracts.monitor import TopicMonitor, referenced_topics, topic_monitor
from mosaico_ingest.contracts.rows import RowMonitor, message_rows, ontology_rows, row_monitor
from mosaico_ingest.contracts.values import Batch
from mosaico_ingest.destinations.store import Store, TopicInfo
from mosaico_ingest.errors import AdapterError, BagError
from mosaico_ingest.job.values import Stores
from mosaico_ingest.report.parts import ContractResult, ExpectationResult
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded
from mosaico_ingest.rosbag.definitions.registry import TypeResolver

_OF_RECORDINGS = frozenset({"unreadable", "chunk_crcs", "metadata_counts"})
"""Expectations that only a recording can fulfill."""


class _Messages(Struct, frozen=True):
    """The messages that the rows of a stored topic can be restored to."""

    definition: Definition
    inverse: Inverse


def check_stored(contract: Contract, store: Store, sequence: str) -> ContractResult:
    """Return the results of a contract for a stored sequence.

    Expressions over ontology columns read the stored columns. Those over message fields read the messages that the
    adapter's inverse restores. What only a recording has, such as chunks and rejected messages, is not evaluated.

    Raises:
        SinkError: The store has no such sequence, or cannot be read.
    """
    info = store.sequence(sequence)
    references = referenced_topics(contract)
    bridge = ROSBridge.for_job(contract.job)
    facts: dict[str, TopicFacts] = {}
    for topic in info.topics:
        monitor = topic_monitor(contract, topic.name, references)
        if monitor is not None:
            _observe(contract, store, topic, monitor, bridge)
        facts[topic.name] = TopicFacts(topic.name, (_msgtype(topic),), count=topic.rows, monitor=monitor)

    def not_stored(clause: Clause) -> ExpectationResult:
        return clause.skipped("the sequence is stored, and its recording is not read")

    return evaluate(
        contract,
        Facts(facts, start_ns=info.start_ns, end_ns=info.end_ns),
        dict.fromkeys(_OF_RECORDINGS, not_stored),
    )


def _observe(
    contract: Contract, store: Store, topic: TopicInfo, monitor: TopicMonitor, bridge: ROSBridge
) -> None:
    messages = _messages(topic, bridge)
    message = None if messages is None else message_rows(messages.definition)
    ontology = ontology_rows(topic.ontology)
    rows, _ = row_monitor(contract, topic.name, _msgtype(topic), message, ontology, stored=True)
    restores = (
        rows is not None
        and messages is not None
        and any(not check.expression.is_ontology for check in rows.checks)
    )
    columns: list[str] | None = [] if rows is None else None
    for batch in _batches(store, topic, columns):
        times = np.asarray(batch.column(0))
        first = monitor.add_block(0, times)
        if rows is None or not len(times):
            continue
        struct = struct_of(batch.columns[1:], topic.ontology.struct, None, batch.num_rows)
        of_batch = Batch(times, first)
        rows.add_stored(struct, of_batch)
        if restores and messages is not None:
            restored = messages.inverse.restore(struct, Envelope(topic.name, _msgtype(topic), times))
            rows = _without_defaulted(rows, restored.defaulted)
            rows.add_values(restored.rows, of_batch)
    if rows is not None:
        monitor.rows[0] = rows
    monitor.finish()


def _batches(store: Store, topic: TopicInfo, columns: list[str] | None) -> Iterator[pa.RecordBatch]:
    yield from store.scan(topic.sequence, topic.name, columns=columns)


def _without_defaulted(rows: RowMonitor, defaulted: tuple[str, ...]) -> RowMonitor:
    """Drop the checks of message fields that are not stored, whose restored values would mislead."""
    absent = set(defaulted)
    rows.checks = tuple(
        check
        for check in rows.checks
        if check.expression.is_ontology or not absent & set(_paths(check.expression.typed))
    )
    return rows


def _paths(typed: TypedExpression) -> Iterator[str]:
    """Yield the dotted paths of the fields that an expression reads, and those of the fields around them."""
    names: list[str] = []
    node: Any = typed
    while isinstance(node, FieldAccess):
        names.append(node.name)
        node = node.operand
    path = ".".join(reversed(names))
    while path:
        yield path
        path = path.rpartition(".")[0]
    for child in _children(node):
        yield from _paths(child)


def _children(node: Any) -> Iterator[TypedExpression]:  # noqa: ANN401 - any node of an expression
    for name in getattr(node, "__struct_fields__", ()):
        value = getattr(node, name)
        for item in value if isinstance(value, tuple) else (value,):
            if hasattr(item, "__struct_fields__") and hasattr(item, "type"):
                yield item


def _messages(topic: TopicInfo, bridge: ROSBridge) -> _Messages | None:
    """Return the messages that a topic can be restored to; None if its metadata or its adapter does not allow that."""
    described = topic.metadata.get(ROS_METADATA_KEY)
    if not isinstance(described, Mapping):
        return None
    text, source = str(described.get("msgdef", "")), str(described.get("source_file", ""))
    version = 1 if source.endswith(".bag") else 2
    try:
        definition = TypeResolver(Stores.EMPTY).resolve(
            _msgtype(topic), Embedded(f"ros{version}msg", text), ros_version=version
        )
        adapter = bridge.resolve(topic.name, definition.root).spec.bind(definition, ros_shape(definition))
        if adapter.ontology != topic.ontology:
            return None
        return _Messages(definition, invert(adapter, definition, topic.metadata))
    except (AdapterError, BagError):
        return None


def _msgtype(topic: TopicInfo) -> str:
    described = topic.metadata.get(ROS_METADATA_KEY)
    return str(described.get("msgtype", "")) if isinstance(described, Mapping) else topic.ontology.tag
