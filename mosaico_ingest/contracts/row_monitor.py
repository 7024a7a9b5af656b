"""Monitors of rows: they observe decoded messages and ontology rows, for the expectations of headers and values."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.mapping.columns import Array
from mosaico_ingest.contracts.clauses import HEADER_KEYS, ROW_KEYS, Clause, Contract, ReadTopic, other_types
from mosaico_ingest.contracts.expressions import (
    Evaluator,
    FieldExpression,
    Rows,
    bind_expression,
    locator,
    message_rows,
    ontology_rows,
    type_findings,
)
from mosaico_ingest.contracts.headers import (
    AllowedTexts,
    frames_of,
    header_numbers_of,
    ontology_stamps_of,
    stamps_of,
)
from mosaico_ingest.contracts.values import (
    Accumulator,
    AllowedValues,
    Batch,
    Changes,
    FiniteNumbers,
    LatencyRange,
    MissingNumbers,
    Moments,
    Nulls,
    NumberLimits,
    Steps,
    Unchanged,
    Values,
)
from mosaico_ingest.errors import ManifestError
from mosaico_ingest.findings import Finding
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.rosbag.blocks import Connection


class FieldCheck(Struct, frozen=True):
    """One expectation of an expression, and its accumulator."""

    clause: Clause
    expression: FieldExpression
    accumulator: Accumulator


@dataclass(slots=True)
class RowMonitor:
    """Observes the rows of one connection, or of one stored topic."""

    topic: str
    msgtype: str
    clauses: Mapping[str, Clause]
    checks: tuple[FieldCheck, ...]
    latency: LatencyRange | None = None
    steps: dict[str, Steps] = field(default_factory=dict[str, Steps])
    """By `monotonic` and `unique`."""
    frames: AllowedTexts | None = None
    numbers: MissingNumbers | None = None
    has_header: bool = True
    """False if the rows have no header with a stamp and a frame."""

    def __post_init__(self) -> None:
        if "latency" in self.clauses:
            expected = self.clauses["latency"].expected
            self.latency = LatencyRange(expected.min, expected.max)
        if "stamps" in self.clauses:
            order = self.clauses["stamps"].expected.order
            self.steps = {
                name: Steps(name == "monotonic") for name in ((order,) if isinstance(order, str) else order)
            }
        if "frame_id" in self.clauses:
            self.frames = AllowedTexts(self.clauses["frame_id"].expected.one_of)
        if "sequence_numbers" in self.clauses:
            self.numbers = MissingNumbers()

    @property
    def needs_messages(self) -> bool:
        """Whether an expectation refers to fields of the message."""
        return bool(HEADER_KEYS & self.clauses.keys()) or any(
            not check.expression.is_ontology for check in self.checks
        )

    @property
    def needs_ontology(self) -> bool:
        """Whether an expectation refers to ontology columns, or to rejected messages."""
        return "rejected" in self.clauses or any(check.expression.is_ontology for check in self.checks)

    def add_messages(self, rows: Array, batch: Batch) -> None:
        """Add decoded messages in the ROS shape."""
        if self.latency is not None or self.steps:
            self._add_stamps(stamps_of(rows), batch)
        if self.frames is not None and (frames := frames_of(rows)) is not None:
            self.frames.add(batch, frames)
        if self.numbers is not None and (numbers := header_numbers_of(rows)) is not None:
            self.numbers.add(batch, numbers)
        self.add_values(rows, batch)

    def add_values(self, rows: Array, batch: Batch) -> None:
        """Add the values of messages in the ROS shape, without their headers."""
        self._add_values(rows, batch, is_ontology=False)

    def add_ontology(self, rows: Array, batch: Batch) -> None:
        """Add ontology rows."""
        self._add_values(rows, batch, is_ontology=True)

    def add_stored(self, rows: Array, batch: Batch) -> None:
        """Add rows of a stored topic, whose header is that of the ontology or of the ROS shape."""
        if self.latency is not None or self.steps:
            ontology_stamps = ontology_stamps_of(rows)
            self._add_stamps(stamps_of(rows) if ontology_stamps is None else ontology_stamps, batch)
        if self.frames is not None and (frames := frames_of(rows)) is not None:
            self.frames.add(batch, frames)
        self._add_values(rows, batch, is_ontology=True)

    def finish(self) -> None:
        """Complete the accumulators after the last batch."""
        for check in self.checks:
            if isinstance(check.accumulator, Unchanged):
                check.accumulator.finish()

    def _add_stamps(self, stamps: NDArray[np.int64] | None, batch: Batch) -> None:
        if stamps is None:
            return
        if self.latency is not None:
            self.latency.add(batch, stamps)
        for steps in self.steps.values():
            steps.add(batch, stamps)

    def _add_values(self, rows: Array, batch: Batch, *, is_ontology: bool) -> None:
        selected = [check for check in self.checks if check.expression.is_ontology is is_ontology]
        if not selected or not len(rows):
            return
        evaluator = Evaluator(rows, Envelope(self.topic, self.msgtype, batch.log_times))
        values: dict[str, Values] = {}
        for check in selected:
            text = check.expression.text
            if text not in values:
                values[text] = evaluator.values(check.expression)
            check.accumulator.add(batch, values[text])


def row_monitor(
    contract: Contract,
    topic: str,
    msgtype: str,
    message: Rows | None,
    ontology: Rows | None,
    *,
    stored: bool = False,
) -> tuple[RowMonitor | None, list[Finding]]:
    """Return the monitor of the rows of a topic and the mistakes of its expressions.

    The monitor is None if nothing about the rows is expected, or if an expression has a mistake.
    """
    clauses = contract.topic_clauses(topic)
    checks: list[FieldCheck] = []
    findings: list[Finding] = []
    for text, expected, of_field in contract.field_clauses(topic):
        path = of_field[0].path[:-1] if of_field else ()
        locate = locator(contract.job.span(*path) if path else None, text)
        expression, mistakes = bind_expression(text, message, ontology, locate)
        if expression is not None:
            mistakes = list(type_findings(expression, expected, locate))
        if mistakes or expression is None:
            findings += mistakes
            continue
        checks += [
            FieldCheck(clause, expression, _ACCUMULATORS[clause.key](clause.expected)) for clause in of_field
        ]
    row_keys = clauses.keys() & ROW_KEYS
    if findings or not (checks or row_keys):
        return None, findings
    shape = ontology if stored else message
    names = () if shape is None else tuple(member.name for member in shape.struct)
    return RowMonitor(topic, msgtype, clauses, tuple(checks), has_header="header" in names), []


def connection_monitor(
    contract: Contract, connection: Connection, topic: ReadTopic
) -> tuple[RowMonitor | None, list[Finding]]:
    """Return the monitor of the rows of a connection as `row_monitor` does."""
    message = None if connection.definition is None else message_rows(connection.definition)
    ontology = None if topic.ontology is None else ontology_rows(topic.ontology)
    return row_monitor(contract, topic.topic, connection.msgtype, message, ontology)


def output_monitor(
    contract: Contract, connection: Connection, name: str, ontology: OntologyType
) -> tuple[RowMonitor | None, list[Finding]]:
    """Return the monitor of the rows of an output of an adapter as `row_monitor` does."""
    return row_monitor(contract, name, connection.msgtype, None, ontology_rows(ontology), stored=True)


def check_expressions(
    contract: Contract, connections: Sequence[Connection], topics: Iterable[ReadTopic]
) -> None:
    """Check the expressions of a contract against the message types of the topics that they apply to.

    A message type that violates the expectation `type` is not checked: its expressions are not evaluated.

    Raises:
        ManifestError: An expression has a mistake; `findings` has all of them, with their locations.
    """
    findings = _expression_findings(contract, connections, topics)
    if not findings:
        return
    first = findings[0]
    more = f" (and {len(findings) - 1} more mistakes)" if len(findings) > 1 else ""
    where = str(first.span or "expect")
    raise ManifestError(f"{first.message}{more}", where=where, hint=first.help, findings=tuple(findings))


def _expression_findings(
    contract: Contract, connections: Sequence[Connection], topics: Iterable[ReadTopic]
) -> list[Finding]:
    by_id = {connection.id: connection for connection in connections}
    findings: dict[Finding, None] = {}
    for topic in topics:
        of_type = contract.topic_clauses(topic.topic).get("type")
        for key in topic.connections:
            if of_type is not None and other_types(of_type.expected, [by_id[key].msgtype]):
                continue  # the violated type is the cause
            _, mistakes = connection_monitor(contract, by_id[key], topic)
            findings.update(dict.fromkeys(mistakes))
            for name, ontology in topic.outputs:
                _, mistakes = output_monitor(contract, by_id[key], name, ontology)
                findings.update(dict.fromkeys(mistakes))
    return list(findings)


_ACCUMULATORS: Mapping[str, Callable[[Any], Accumulator]] = {
    "between": lambda expected: NumberLimits(*expected),
    "min": lambda expected: NumberLimits(low=expected),
    "max": lambda expected: NumberLimits(high=expected),
    "finite": lambda _: FiniteNumbers(),
    "nulls": Nulls,
    "equals": lambda expected: AllowedValues((expected,)),
    "one_of": lambda expected: AllowedValues(tuple(expected)),
    "mean": lambda _: Moments(),
    "std": lambda _: Moments(),
    "change": lambda expected: Changes(
        -np.inf if expected.min is None else expected.min, np.inf if expected.max is None else expected.max
    ),
    "unchanged": lambda expected: Unchanged(expected.max),
}
"""The constructors of accumulators of values, by key of the expectation."""
