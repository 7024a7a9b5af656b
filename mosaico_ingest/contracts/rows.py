"""Rows of topics: the expressions of field expectations, header columns, and the monitors that observe both."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from msgspec import Struct, field
from msgspec.structs import replace
from numpy.typing import NDArray

from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.mapping.checker import Analyzer, Scope
from mosaico_ingest.adapters.mapping.columns import (
    Array,
    Axis,
    ExprType,
    arrays,
    field_of,
    format_type,
    is_list,
    is_number,
    null_mask,
    pc,
    pt,
    time_ns,
)
from mosaico_ingest.adapters.mapping.evaluator import Evaluation, RowsRejected
from mosaico_ingest.adapters.mapping.expressions import TypedExpression
from mosaico_ingest.contracts import HEADER_KEYS, ROW_KEYS, Clause, Contract, ReadTopic, other_types
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
    Violations,
    plain_values,
)
from mosaico_ingest.errors import ManifestError
from mosaico_ingest.findings import Finding, Severity, Span
from mosaico_ingest.job.expect import FieldExpectations
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.rosbag.blocks import Connection
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, MessageType

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
NUMERIC = frozenset({"between", "min", "max", "finite", "mean", "std", "change"})
"""Expectations that require numbers."""
SINGLE = frozenset({"change", "unchanged"})
"""Expectations that require one value per message."""
Locate = Callable[[int, int], Span | None]
"""Returns the location of some characters of an expression."""


class FieldCheck(Struct, frozen=True):
    """One expectation of an expression, and its accumulator."""

    clause: Clause
    expression: FieldExpression
    accumulator: Accumulator


class RowMonitor(Struct):
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


class AllowedTexts(Struct):
    """Texts that must be in a set, such as frame ids."""

    allowed: tuple[str, ...]
    count: int = 0
    seen: dict[str, None] = field(default_factory=dict[str, None])
    """The first texts that are not allowed."""
    violations: Violations = field(default_factory=Violations)

    def add(self, batch: Batch, texts: Array) -> None:
        """Add the texts of a batch; null counts as an empty text."""
        if not len(texts):
            return
        self.count += len(texts)
        if texts.null_count:
            texts = texts.fill_null("")
        allowed = pc.is_in(texts, value_set=arrays.array(self.allowed, texts.type))
        if allowed.true_count == len(texts):
            return
        bad = ~np.asarray(allowed)
        for text in pc.unique(texts.filter(arrays.array(bad))).slice(0, 5).to_pylist():
            self.seen[text] = None
        self.violations.add(batch, plain_values(texts.to_numpy(zero_copy_only=False)), bad)


def stamps_of(rows: Array) -> NDArray[np.int64] | None:
    """Return the header stamps of messages in nanoseconds, shape (n,), 0 for null; None without a header stamp."""
    return _times(_member(rows, "header", "stamp"), ("sec", "nanosec"))


def ontology_stamps_of(rows: Array) -> NDArray[np.int64] | None:
    """Return the header stamps of stored rows in nanoseconds, shape (n,), 0 for null; None without a header."""
    return _times(_member(rows, "header", "timestamp"), ("seconds", "nanoseconds"))


def frames_of(rows: Array) -> Array | None:
    """Return the frame ids as an Arrow array; None if the rows have no header with a frame."""
    return _member(rows, "header", "frame_id")


def header_numbers_of(rows: Array) -> NDArray[np.int64] | None:
    """Return `header.seq` of ROS 1, shape (n,); None if the rows have none."""
    numbers = _member(rows, "header", "seq")
    return None if numbers is None else _numbers(numbers).astype(np.int64)


def _member(rows: Array, *names: str) -> Array | None:
    for name in names:
        if not pt.is_struct(rows.type) or rows.type.get_field_index(name) < 0:
            return None
        rows = field_of(rows, name)
    return rows


def _times(times: Array | None, parts: tuple[str, str]) -> NDArray[np.int64] | None:
    fields = [None if times is None else _member(times, part) for part in parts]
    columns = [column for column in fields if column is not None]
    if len(columns) < len(parts):
        return None
    if any(column.null_count for column in columns):
        return _numbers(time_ns(times, parts))
    seconds, nanoseconds = map(np.asarray, columns)
    stamps = np.multiply(seconds, 1_000_000_000, dtype=np.int64)
    stamps += nanoseconds.astype(np.int64, copy=False)
    return stamps


def _numbers(array: Array) -> NDArray[Any]:
    return np.asarray(array.fill_null(0) if array.null_count else array)


class Rows(Struct, frozen=True):
    """The rows that expressions refer to: messages in the ROS shape, or ontology rows."""

    struct: pa.StructType
    types: Mapping[str, MessageType] = {}
    root: str | None = None
    """The message type; None for ontology rows."""
    title: str = "the rows"
    """The name in messages, such as `IMU`."""
    has_envelope: bool = False
    """Whether expressions can use `message.log_time` and the other properties of messages besides their content."""

    @property
    def scope(self) -> Scope:
        """The names that expressions can use."""
        return Scope(ExprType(self.struct, msgtype=self.root), self.types, has_envelope=self.has_envelope)


class FieldExpression(Struct, frozen=True):
    """A typed expression, and the rows that it refers to."""

    text: str
    typed: TypedExpression
    is_ontology: bool

    @property
    def is_single(self) -> bool:
        """Whether the expression has one value per message."""
        return not self.typed.type.axes


def message_rows(definition: Definition) -> Rows:
    """Return the rows of messages in the ROS shape."""
    return Rows(ros_shape(definition), definition.types, definition.root, definition.root)


def ontology_rows(ontology: OntologyType) -> Rows:
    """Return the rows of an ontology type."""
    return Rows(ontology.struct, {}, None, ontology.tag)


def locator(span: Span | None, text: str) -> Locate:
    """Return a function that locates characters of an expression inside of the span of a key or value."""

    def locate(start: int, end: int) -> Span | None:
        if span is None or span.line != span.end_line or span.end_column - span.column < len(text):
            return span  # the text is folded or escaped
        quote = (span.end_column - span.column - len(text)) // 2
        first = span.column + quote
        return Span(span.file, span.line, first + start, span.line, first + max(end, start + 1))

    return locate


def syntax_findings(text: str, locate: Locate) -> list[Finding]:
    """Return the mistakes of an expression that are independent of the message type."""
    analyzer = _analyzer(locate)
    analyzer.expression((), text, None)
    return analyzer.findings


def bind_expression(
    text: str, message: Rows | None, ontology: Rows | None, locate: Locate
) -> tuple[FieldExpression | None, list[Finding]]:
    """Return the typed expression over the message, or else over the ontology columns, or its mistakes.

    If neither has the names of the expression, the mistakes are those over the message, and the hint also lists the
    ontology columns.
    """
    attempts: list[list[Finding]] = []
    for rows in (message, ontology):
        if rows is None:
            continue
        analyzer = _analyzer(locate)
        analyzed = analyzer.expression((), text, rows.scope)
        if analyzed is not None and analyzed.typed is not None:
            return FieldExpression(text, analyzed.typed, rows is ontology), []
        attempts.append(analyzer.findings)
    if not attempts:
        return None, []
    findings = attempts[0]
    if len(attempts) > 1 and ontology is not None and findings[0].rule == "unknown-field":
        first, other = findings[0], attempts[1][0]
        names = ", ".join(field.name for field in ontology.struct)
        nearest = (other.help or "").partition("?")[0] if "did you mean" in (other.help or "") else ""
        hint = (
            f"{nearest}? {first.help}" if nearest and "did you mean" not in (first.help or "") else first.help
        )
        findings = [replace(first, help=f"{hint}; {ontology.title} has the columns {names}"), *findings[1:]]
    return None, findings


def type_findings(
    expression: FieldExpression, expected: FieldExpectations, locate: Locate
) -> Iterator[Finding]:
    """Yield a finding for each expectation that does not fit the type of the expression."""
    element = expression.typed.type.element
    kind, text = element.arrow, f"`{expression.text}`"
    span = locate(0, len(expression.text))

    def finding(message: str, hint: str | None) -> Finding:
        return Finding("operand-type", Severity.ERROR, message, span, hint)

    if is_list(kind):
        hint = f"write {expression.text}[] to check each element"
        yield finding(f"{text} is {format_type(element)}, not a single value", hint)
    elif pt.is_nested(kind) or pt.is_binary(kind) or pt.is_null(kind):
        hint = f"name a field: {', '.join(field.name for field in kind)}" if pt.is_struct(kind) else None
        yield finding(f"{text} is {format_type(element)}, not a number, text or boolean", hint)
    else:
        names = expected.model_fields_set
        for name in sorted(names & NUMERIC) if not is_number(kind) else ():
            yield finding(f"{name} requires a number, {text} is {format_type(element)}", f"remove {name}")
        for name in sorted(names & SINGLE) if not expression.is_single else ():
            hint = f"select an element, such as [0], or remove {name}"
            yield finding(f"{name} requires one value per message, {text} has a list of values", hint)
        for value in (*(expected.one_of or ()), *(() if expected.equals is None else (expected.equals,))):
            if not _is_comparable(value, kind):
                hint = "write a value of this type"
                yield finding(f"{text} is {format_type(element)} and never equals {value!r}", hint)


class Evaluator:
    """Evaluates expressions over one batch of rows; rows without a value of one expression count as null for it."""

    def __init__(self, rows: Array, envelope: Envelope) -> None:
        self._rows = rows
        self._envelope = envelope
        self._evaluation = Evaluation(rows, envelope)

    def values(self, expression: FieldExpression) -> Values:
        """Return the values of an expression."""
        try:
            return _values(self._evaluation, expression)
        except RowsRejected as error:
            return self._without(expression, error)

    def _without(self, expression: FieldExpression, error: RowsRejected) -> Values:
        """Evaluate the rows that have a value, and add one null for each other row."""
        accepted = np.ones(len(self._rows), bool)
        while True:
            remaining = np.flatnonzero(accepted)
            accepted[remaining[list(error.rejections)]] = False
            remaining = np.flatnonzero(accepted)
            rows = self._rows.filter(arrays.array(accepted))
            try:
                values = _values(Evaluation(rows, self._envelope.take(accepted)), expression)
                break
            except RowsRejected as again:
                error = again
        rejected = np.flatnonzero(~accepted)
        parents = remaining if values.rows is None else remaining[values.rows]
        rows_of = np.concatenate([parents, rejected])
        order = np.argsort(rows_of, kind="stable")
        null = np.zeros(len(values.data), bool) if values.null is None else values.null
        data = np.concatenate([values.data, np.zeros(len(rejected), values.data.dtype)])
        nulls = np.concatenate([null, np.ones(len(rejected), bool)])
        return Values(data[order], nulls[order], None if values.rows is None else rows_of[order])


def _values(evaluation: Evaluation, expression: FieldExpression) -> Values:
    column = evaluation.evaluate(expression.typed)
    count = evaluation.count(column.axes)
    array = column.array(count)
    null = null_mask(array)
    if pt.is_null(array.type):
        return Values(np.zeros(count), np.ones(count, bool), _parents(column.axes))
    if null is not None:
        array = array.fill_null("" if pt.is_string(array.type) else False if pt.is_boolean(array.type) else 0)
    data = array.to_numpy(zero_copy_only=False)
    return Values(data, null, _parents(column.axes))


def _parents(axes: tuple[Axis, ...]) -> NDArray[np.int64] | None:
    rows: NDArray[np.int64] | None = None
    for axis in reversed(axes):
        parents = axis.parents
        rows = parents if rows is None else parents[rows]
    return rows


def _is_comparable(value: object, kind: object) -> bool:
    if isinstance(value, bool):
        return pt.is_boolean(kind)
    if isinstance(value, str):
        return pt.is_string(kind)
    return isinstance(value, int | float) and is_number(kind)


def _analyzer(locate: Locate) -> Analyzer:
    return Analyzer(lambda: _Location(locate))  # type: ignore[arg-type, return-value] - has the part of `Source` that expressions use


class _Location:
    """The locations of an expression, in place of the source of an adapter file."""

    def __init__(self, locate: Locate) -> None:
        self._locate = locate

    def inner_span(self, _path: object, start: int, end: int) -> Span | None:
        return self._locate(start, end)
