"""The conditions `where` and `on_change` of topic settings: static checks, and their evaluation over decoded messages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.mapping.columns import pt
from mosaico_ingest.adapters.mapping.types import format_type, is_list
from mosaico_ingest.contracts.rows import (
    Evaluator,
    FieldExpression,
    Locate,
    Rows,
    bind_expression,
    locator,
    message_rows,
)
from mosaico_ingest.contracts.values import Values
from mosaico_ingest.errors import ManifestError
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.job.model import Job
from mosaico_ingest.job.values import first_match
from mosaico_ingest.pipeline.plan import TopicPlan
from mosaico_ingest.rosbag.blocks import Connection
from mosaico_ingest.rosbag.definitions.model import Definition

Mask = NDArray[np.bool_]


class Conditions(Struct, frozen=True):
    """The conditions of a topic, bound to one message definition."""

    where: FieldExpression | None
    on_change: tuple[FieldExpression, ...]


def bind_conditions(plan: TopicPlan, definition: Definition) -> Conditions:
    """Return the conditions of a plan that `check_conditions` accepted."""
    rows = _condition_rows(definition)
    where = None if plan.where is None else _bind(plan.where, rows)
    return Conditions(where, tuple(_bind(text, rows) for text in plan.on_change))


def _condition_rows(definition: Definition) -> Rows:
    return replace(message_rows(definition), has_envelope=True)


def _bind(text: str, rows: Rows) -> FieldExpression:
    expression, findings = bind_expression(text, rows, None, locator(None, text))
    if expression is None:
        raise ManifestError(findings[0].message)
    return expression


def check_conditions(job: Job, topics: Iterable[TopicPlan], connections: Sequence[Connection]) -> None:
    """Check the conditions against the message types of the topics that they apply to.

    Raises:
        ManifestError: An expression has a mistake; `findings` has all of them, with their locations.
    """
    by_id = {connection.id: connection for connection in connections}
    findings: dict[Finding, None] = {}
    for topic in topics:
        for path, text in conditions_of(job, topic.topic):
            locate = locator(job.value_span(*path), text)
            for number in topic.connections:
                definition = by_id[number].definition
                if definition is not None:
                    mistakes = condition_findings(path, text, _condition_rows(definition), locate)
                    findings.update(dict.fromkeys(mistakes))
    if findings:
        first, *rest = findings
        more = f" (and {len(rest)} more mistakes)" if rest else ""
        where = str(first.span or "topic_settings")
        raise ManifestError(f"{first.message}{more}", where=where, hint=first.help, findings=tuple(findings))


def conditions_of(job: Job, topic: str) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """Yield the key path and the text of each condition of a topic."""
    for name in ("where", "on_change"):
        globs = (glob for glob, entry in job.topic_settings.items() if name in entry.model_fields_set)
        glob = first_match(globs, topic)
        if glob is None:
            continue
        value = getattr(job.topic_settings[glob], name)
        texts = (
            [((name,), value)]
            if isinstance(value, str)
            else [((name, position), text) for position, text in enumerate(value or ())]
        )
        yield from ((("topic_settings", glob, *keys), text) for keys, text in texts)


def condition_findings(
    path: tuple[str | int, ...], text: str, rows: Rows, locate: Locate
) -> Iterator[Finding]:
    """Yield the mistakes of one condition over messages of a type."""
    expression, mistakes = bind_expression(text, rows, None, locate)
    if expression is None:
        yield from mistakes
        return
    element, span = expression.typed.type.element, locate(0, len(text))
    kind, title = element.arrow, format_type(element)
    if not expression.is_single or is_list(kind):
        hint = "reduce the list to one value, for example with any(…), all(…), max(…) or an index such as [0]"
        message = f"`{text}` has a list of values, not one value per message"
    elif "where" in path and not pt.is_boolean(kind):
        message, hint = f"`{text}` is {title}, not a condition", "compare it with a value, such as `> 0`"
    elif pt.is_nested(kind) or pt.is_binary(kind) or pt.is_null(kind):
        names = f"name a field: {', '.join(member.name for member in kind)}" if pt.is_struct(kind) else None
        message, hint = f"`{text}` is {title}, not a number, text or boolean", names
    else:
        return
    yield Finding("operand-type", Severity.ERROR, message, span, hint)


@dataclass(slots=True)
class ConditionFilter:
    """Evaluates the conditions of one topic; its state spans all blocks of the topic."""

    _previous: list[Any] = field(default_factory=list[Any])
    """The value of each expression of `on_change` in the latest message that `where` kept; None is null."""

    def select(self, conditions: Conditions, rows: pa.StructArray, envelope: Envelope) -> tuple[Mask, Mask]:
        """Return where `where` is true, and where `on_change` keeps such a message; both have shape (n,)."""
        keep = np.ones(len(rows), bool)
        if conditions.where is not None:
            values = Evaluator(rows, envelope).values(conditions.where)
            keep = values.data.astype(bool)
            if values.null is not None:
                keep = keep & ~values.null
        changed = keep.copy()
        if conditions.on_change and keep.any():
            matches = rows if keep.all() else rows.filter(pa.array(keep))
            evaluator = Evaluator(matches, envelope.take(keep))
            changed[keep] = self._changes(conditions.on_change, evaluator, len(matches))
        return keep, changed

    def _changes(self, expressions: Sequence[FieldExpression], evaluator: Evaluator, count: int) -> Mask:
        """Return where an expression differs from the previous message; the first message of a topic differs."""
        changed = np.zeros(count, bool)
        previous = self._previous
        self._previous = []
        for position, expression in enumerate(expressions):
            values = evaluator.values(expression)
            changed[1:] |= _differs(values)
            first, last = _value(values, 0), _value(values, count - 1)
            changed[0] |= not previous or not _equal(first, previous[position])
            self._previous.append(last)
        return changed


def _differs(values: Values) -> Mask:
    """Return whether each value differs from its predecessor, shape (n - 1,); NaN equals NaN, and null equals null."""
    data = values.data
    differs = data[1:] != data[:-1]
    if data.dtype.kind == "f":
        differs &= ~(np.isnan(data[1:]) & np.isnan(data[:-1]))
    if values.null is None:
        return differs
    before, after = values.null[:-1], values.null[1:]
    return (before != after) | (differs & ~before & ~after)


def _value(values: Values, position: int) -> Any:  # noqa: ANN401 - a number, text, boolean or None
    is_null = values.null is not None and bool(values.null[position])
    return None if is_null else values.data[position]


def _equal(one: Any, other: Any) -> bool:  # noqa: ANN401 - numbers, texts, booleans or None
    if one is None or other is None:
        return one is other
    return bool(one == other) or bool(one != one and other != other)  # noqa: PLR0124 - NaN differs from itself
