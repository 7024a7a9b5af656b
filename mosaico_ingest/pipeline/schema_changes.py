"""Comparison of a plan's message definitions with those of earlier sequences of the same family."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from difflib import unified_diff
from typing import Any

from msgspec import Struct

from mosaico_ingest.adapters.adapter import recorded_schema
from mosaico_ingest.destinations.base import destination_of
from mosaico_ingest.errors import IngestError
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.job.values import OnSchemaChange
from mosaico_ingest.pipeline.plan import Plan, TopicPlan
from mosaico_ingest.protocol import check_topic_name


class _StoredDefinition(Struct, frozen=True):
    """A definition that a sequence of the family has for a topic."""

    sequence: str
    text: str


def follow_schema_changes(plan: Plan, action: OnSchemaChange) -> Plan:
    """Return the plan with a finding for each changed definition, and with changed topics renamed for `new_topic`.

    Raises:
        IngestError: A definition has changed and the action is `fail`; `findings` has every change.
    """
    stored = _stored_definitions(plan)
    if stored is None:
        unchecked = Finding(
            "schema-change-unchecked",
            Severity.WARNING,
            "on_schema_change needs a store; a server does not list its definitions",
        )
        return plan.replace(findings=(*plan.findings, unchecked))
    findings: list[Finding] = []
    topics: list[TopicPlan] = []
    for topic in plan.topics:
        history = stored.get(check_topic_name(topic.target), [])
        reference = history[:1] if action is OnSchemaChange.NEW_TOPIC else history[-1:]
        text = _definition(topic.metadata)
        changed = next((one for one in reference if text is not None and one.text != text), None)
        if changed is None or text is None:
            topics.append(topic)
            continue
        target = _versioned_name(topic.target, text) if action is OnSchemaChange.NEW_TOPIC else topic.target
        topics.append(topic.replace(target=target))
        findings.append(_finding(topic, changed, text, action, target))
    if findings and action is OnSchemaChange.FAIL:
        raise IngestError(
            f"{len(findings)} message definitions have changed; the first: {findings[0].message}",
            where=str(plan.files[0]),
            hint="set on_schema_change to evolve or new_topic, or use another sequence.family",
            findings=tuple(findings),
        )
    return plan.replace(topics=tuple(topics), findings=(*plan.findings, *findings))


def _stored_definitions(plan: Plan) -> dict[str, list[_StoredDefinition]] | None:
    """Return the stored definitions by topic in the order of the family's sessions, or None if they cannot be listed."""
    names = {check_topic_name(topic.target) for topic in plan.topics}
    stored = destination_of(plan.destination).family_topics(plan.sequence.family, names)
    if stored is None:
        return None
    by_topic: dict[str, list[_StoredDefinition]] = {}
    for topic in stored:
        text = _definition(topic.metadata)
        if text is not None:
            by_topic.setdefault(topic.name, []).append(_StoredDefinition(topic.sequence, text))
    return by_topic


def _definition(metadata: Mapping[str, Any]) -> str | None:
    schema = recorded_schema(metadata)
    return None if schema is None else schema.text


def _versioned_name(target: str, text: str) -> str:
    return f"{target}/v_{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _finding(
    topic: TopicPlan, old: _StoredDefinition, text: str, action: OnSchemaChange, target: str
) -> Finding:
    lines = ", ".join(_changed_lines(old.text, text))
    stored = f"; it is stored as {target}" if action is OnSchemaChange.NEW_TOPIC else ""
    severity = Severity.ERROR if action is OnSchemaChange.FAIL else Severity.WARNING
    return Finding(
        "schema-change",
        severity,
        f"{topic.topic}: {topic.msgtype} differs from its definition in {old.sequence}: {lines}{stored}",
    )


def _changed_lines(old: str, new: str) -> Iterator[str]:
    """Yield the lines that differ, such as `-float64 x` and `+float32 x`."""
    for line in unified_diff(old.splitlines(), new.splitlines(), lineterm="", n=0):
        if line[:1] in "+-" and line[:3] not in {"+++", "---"}:
            yield line
