"""This file holds the message definitions of a recording against those its family of sequences was made with."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from difflib import unified_diff
from typing import Any, cast

from mosaico_ingest.adapters.metadata import ROS_METADATA_KEY
from mosaico_ingest.config import LEDGER_KEY, StoreTarget
from mosaico_ingest.diagnostics import Finding, Severity
from mosaico_ingest.errors import IngestError
from mosaico_ingest.frozen import frozen
from mosaico_ingest.plan.model import Plan, TopicPlan
from mosaico_ingest.policies import OnSchemaChange
from mosaico_ingest.store.store import Store
from mosaico_ingest.wire import check_topic_name

__all__ = ["follow_schema_changes"]


@frozen
class _Known:
    """A definition that a sequence of the family has for a topic."""

    sequence: str
    text: str


def follow_schema_changes(plan: Plan, wanted: OnSchemaChange) -> Plan:
    """Return the plan with what there is to say about changed definitions, and with topics renamed where wanted.

    Raises:
        IngestError: A definition has changed and the job says to fail then; `findings` has every difference.
    """
    if not isinstance(plan.target, StoreTarget):
        unchecked = Finding(
            "schema-change-unchecked",
            Severity.WARNING,
            "on_schema_change is for stores: a server is not asked for the definitions it has",
        )
        return replace(plan, findings=(*plan.findings, unchecked))
    known = _known(plan.target, plan.family)
    findings: list[Finding] = []
    topics: list[TopicPlan] = []
    for topic in plan.topics:
        history = known.get(check_topic_name(topic.target), [])
        against = history[:1] if wanted is OnSchemaChange.NEW_TOPIC else history[-1:]
        text = _text(topic.metadata)
        changed = next((one for one in against if text is not None and one.text != text), None)
        if changed is None or text is None:
            topics.append(topic)
            continue
        target = _new_name(topic.target, text) if wanted is OnSchemaChange.NEW_TOPIC else topic.target
        topics.append(replace(topic, target=target))
        findings.append(_finding(topic, changed, text, wanted, target))
    if findings and wanted is OnSchemaChange.FAIL:
        raise IngestError(
            f"{len(findings)} message definitions have changed; the first: {findings[0].message}",
            where=str(plan.files[0]),
            hint="set on_schema_change to evolve or new_topic, or name another sequence.family",
            findings=tuple(findings),
        )
    return replace(plan, topics=tuple(topics), findings=(*plan.findings, *findings))


def _known(target: StoreTarget, family: str | None) -> dict[str, list[_Known]]:
    """Return the definitions by topic, in the order the family's sessions were written."""
    store = Store.find(target.path)
    found: dict[str, list[tuple[str, _Known]]] = {}
    for info in store.sequences() if store else ():
        sessions = {one.id for one in info.sessions if _family(one.metadata) == family}
        for topic in info.topics:
            text = _text(topic.metadata)
            if topic.session in sessions and text is not None:
                found.setdefault(topic.name, []).append((topic.session, _Known(info.name, text)))
    return {
        name: [known for _, known in sorted(history, key=lambda one: one[0])]
        for name, history in found.items()
    }


def _family(metadata: Mapping[str, Any]) -> object:
    return _member(metadata.get(LEDGER_KEY), "family")


def _text(metadata: Mapping[str, Any]) -> str | None:
    text = _member(metadata.get(ROS_METADATA_KEY), "msgdef")
    return text if isinstance(text, str) else None


def _member(value: object, key: str) -> object:
    return cast("Mapping[str, object]", value).get(key) if isinstance(value, Mapping) else None


def _new_name(target: str, text: str) -> str:
    return f"{target}/v_{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _finding(topic: TopicPlan, old: _Known, text: str, wanted: OnSchemaChange, target: str) -> Finding:
    lines = ", ".join(_changes(old.text, text))
    stored = f"; it is stored as {target}" if wanted is OnSchemaChange.NEW_TOPIC else ""
    severity = Severity.ERROR if wanted is OnSchemaChange.FAIL else Severity.WARNING
    return Finding(
        "schema-change",
        severity,
        f"{topic.topic}: {topic.msgtype} is not what it was in {old.sequence}: {lines}{stored}",
    )


def _changes(old: str, new: str) -> Iterator[str]:
    """Yield the lines that differ, as `-float64 x` and `+float32 x`."""
    for line in unified_diff(old.splitlines(), new.splitlines(), lineterm="", n=0):
        if line[:1] in "+-" and line[:3] not in {"+++", "---"}:
            yield line
