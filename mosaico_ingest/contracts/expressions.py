"""Expressions of field expectations: static checks, and their values over the rows of a batch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np
import pyarrow as pa
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.mapping.analyzer import Analyzer
from mosaico_ingest.adapters.mapping.checker import Scope
from mosaico_ingest.adapters.mapping.columns import Array, Axis, arrays, null_mask, pt
from mosaico_ingest.adapters.mapping.evaluator import Evaluation, RowsRejected
from mosaico_ingest.adapters.mapping.expressions import TypedExpression
from mosaico_ingest.adapters.mapping.types import ExprType, format_type, is_list, is_number
from mosaico_ingest.contracts.values import Values
from mosaico_ingest.findings import Finding, Severity, Span
from mosaico_ingest.job.expect import FieldExpectations
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, MessageType

NUMERIC = frozenset({"between", "min", "max", "finite", "mean", "std", "change"})
"""Expectations that require numbers."""
SINGLE = frozenset({"change", "unchanged"})
"""Expectations that require one value per message."""

Locate = Callable[[int, int], Span | None]
"""Returns the location of some characters of an expression."""


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
