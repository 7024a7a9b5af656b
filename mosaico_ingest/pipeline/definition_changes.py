"""Changes of definitions: the lock file of a job, and earlier sequences of the same family."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import unified_diff
from enum import Enum
from typing import Any, Literal

import pyarrow.types as pt
from msgspec import Struct
from pydantic import Field

from mosaico_ingest.adapters.adapter import recorded_schema
from mosaico_ingest.destinations import destination_of
from mosaico_ingest.display import counted
from mosaico_ingest.documents import Part, read_document
from mosaico_ingest.errors import ContractError, IngestError
from mosaico_ingest.findings import Finding, Severity, Span
from mosaico_ingest.job.values import LockFile, OnSchemaChange
from mosaico_ingest.job.yaml_source import KeyPath, load_source
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.pipeline.plan import Plan, TopicPlan
from mosaico_ingest.protocol import check_topic_name
from mosaico_ingest.rosbag.blocks import Connection
from mosaico_ingest.rosbag.definitions.model import Definition, spell

_HINT = "write a lock file with `ingest schema lock job.yaml`"

Types = Mapping[str, tuple[str, ...]]
"""The lines of each message type."""


class LockedTopic(Part):
    """The message type of a topic, and the ontology type and columns that it is stored as."""

    type: str
    required: bool = True
    """False if not every locked recording has the topic."""
    definition: str
    """The key of the topic's entry in `definitions`."""
    ontology: str
    """The tag of the ontology type."""
    columns: dict[str, str]
    """The Arrow type of each output column, in their order; columns of structs have names with dots."""


class LockDocument(Part):
    """A lock file. Entries are sorted by name, so that two versions can be compared line by line."""

    version: Literal[1] = 1
    topics: dict[str, LockedTopic] = Field(examples=[{}])
    """Every selected topic by its name in the recording."""
    definitions: dict[str, dict[str, tuple[str, ...]]]
    """For each message type of a topic, the constants and fields of the type and of all types in it, one line each as in a
    `.msg` file."""

    def text(self) -> str:
        """Return the content of the file."""
        return json.dumps(self.model_dump(mode="json"), indent=2, ensure_ascii=False) + "\n"


class Change(str, Enum):
    """The kind of a difference between a lock file and a recording."""

    NEW_TOPIC = "new topic"
    MISSING_TOPIC = "missing topic"
    CHANGED_TYPE = "changed type"
    NEW_TYPE = "new nested type"
    MISSING_TYPE = "missing nested type"
    NEW_FIELD = "new field"
    MISSING_FIELD = "missing field"
    RENAMED_FIELD = "renamed field"
    CHANGED_FIELD = "changed field"
    MOVED_FIELD = "moved field"
    NEW_CONSTANT = "new constant"
    MISSING_CONSTANT = "missing constant"
    CHANGED_CONSTANT = "changed constant"
    CHANGED_ONTOLOGY = "changed ontology type"
    NEW_COLUMN = "new column"
    MISSING_COLUMN = "missing column"
    CHANGED_COLUMN = "changed column"
    MOVED_COLUMN = "moved column"


class LockDifference(Struct, frozen=True):
    """One difference between a lock file and a recording."""

    change: Change
    topic: str
    text: str
    path: KeyPath
    """The key path in the lock file, or of the nearest entry."""

    def __str__(self) -> str:
        """Return the difference in one line."""
        return f"{self.topic}: {self.change.value} {self.text}"


def read_lock(file: LockFile) -> LockDocument:
    """Parse a lock file.

    Raises:
        ManifestError: The text is not a lock file.
    """
    return read_document(file.text.encode(), LockDocument, where=file.path, kind="a lock file", hint=_HINT)


def lock_of(plan: Plan, connections: Sequence[Connection]) -> LockDocument:
    """Return the lock of one recording's plan; `connections` are the recording's connections, by id."""
    topics: dict[str, LockedTopic] = {}
    definitions: dict[str, dict[str, tuple[str, ...]]] = {}
    for topic in plan.topics:
        name = topic.topic if topic.topic not in topics else f"{topic.topic} as {topic.target}"
        candidates = (connections[connection].definition for connection in topic.connections)
        types = _types_of([definition for definition in candidates if definition is not None])
        key = _definition_key(definitions, topic.msgtype, types)
        definitions[key] = types
        topics[name] = LockedTopic(
            type=topic.msgtype, definition=key, ontology=topic.ontology.tag, columns=_columns(topic.ontology)
        )
    return _sorted(topics, definitions)


def merge_locks(locks: Sequence[tuple[str, LockDocument]]) -> LockDocument:
    """Return one lock for several recordings, given with their names; topics that some of them lack are not required.

    Raises:
        ContractError: Two recordings differ in a topic; `findings` has every difference.
    """
    topics: dict[str, LockedTopic] = {}
    definitions: dict[str, dict[str, tuple[str, ...]]] = {}
    owners: dict[str, tuple[str, LockDocument]] = {}
    findings: list[Finding] = []
    for recording, lock in locks:
        for name, topic in lock.topics.items():
            if name not in owners:
                owners[name] = (recording, lock)
                types = lock.definitions[topic.definition]
                key = _definition_key(definitions, topic.type, types)
                definitions[key] = types
                topics[name] = topic.replace(
                    definition=key, required=all(name in other.topics for _, other in locks)
                )
                continue
            owner, reference = owners[name]
            for difference in _topic_differences(name, reference, lock):
                message = f"{difference}, in {recording} compared with {owner}"
                findings.append(Finding("definition-difference", Severity.ERROR, message))
    if findings:
        raise ContractError(
            "the recordings differ, so one lock file cannot describe them",
            hint="lock each group of recordings with a manifest of its own",
            findings=tuple(findings),
        )
    return _sorted(topics, definitions)


def check_lock(file: LockFile, actual: LockDocument, *, recording: str) -> None:
    """Compare a recording with a lock file.

    Raises:
        ContractError: They differ; `findings` has every difference with its location in the lock file.
        ManifestError: The text is not a lock file.
    """
    differences = lock_differences(read_lock(file), actual)
    if not differences:
        return
    first = differences[0]
    source = load_source(file.text, file=file.path)
    findings = tuple(
        Finding(
            "definition-difference",
            Severity.ERROR,
            str(difference),
            _span(source.spans, source.key_spans, difference.path),
        )
        for difference in differences
    )
    more = f" (and {counted(len(differences) - 1, 'more difference')})" if len(differences) > 1 else ""
    raise ContractError(
        f"the recording differs from {file.path}: {first}{more}",
        where=recording,
        hint="review the differences, then update the lock file with `ingest schema lock`",
        findings=findings,
    )


def lock_differences(lock: LockDocument, actual: LockDocument) -> tuple[LockDifference, ...]:
    """Return the differences of a recording from a lock, by topic."""
    differences: list[LockDifference] = []
    for name in sorted({*lock.topics, *actual.topics}):
        if name in lock.topics and name in actual.topics:
            differences += _topic_differences(name, lock, actual)
        elif name in actual.topics:
            differences.append(LockDifference(Change.NEW_TOPIC, name, actual.topics[name].type, ("topics",)))
        elif lock.topics[name].required:
            path = ("topics", name)
            differences.append(LockDifference(Change.MISSING_TOPIC, name, lock.topics[name].type, path))
    return tuple(dict.fromkeys(differences))


def _sorted(
    topics: Mapping[str, LockedTopic], definitions: Mapping[str, Mapping[str, tuple[str, ...]]]
) -> LockDocument:
    return LockDocument(
        topics=dict(sorted(topics.items())),
        definitions={key: dict(sorted(types.items())) for key, types in sorted(definitions.items())},
    )


def _definition_key(definitions: Mapping[str, Types], msgtype: str, types: Types) -> str:
    """Return the key for a definition: its type, with a number if another definition has this name."""
    key, number = msgtype, 1
    while key in definitions and definitions[key] != types:
        number += 1
        key = f"{msgtype} ({number})"
    return key


def _types_of(definitions: Sequence[Definition]) -> dict[str, tuple[str, ...]]:
    """Return the lines of every type that the definitions use; those of a second definition have a number."""
    lines: dict[str, tuple[str, ...]] = {}
    for definition in definitions:
        for name in _used_types(definition):
            text = tuple(spell(definition.types[name]).splitlines())
            lines[_definition_key({key: {"": value} for key, value in lines.items()}, name, {"": text})] = (
                text
            )
    return dict(sorted(lines.items()))


def _used_types(definition: Definition) -> Iterable[str]:
    used: dict[str, None] = {definition.root: None}
    waiting = [definition.root]
    while waiting:
        for field in definition.types[waiting.pop()].fields:
            if field.is_message and field.type not in used:
                used[field.type] = None
                waiting.append(field.type)
    return used


def _columns(ontology: OntologyType) -> dict[str, str]:
    return dict(_leaves(list(ontology.struct), ""))


def _leaves(fields: Iterable[Any], prefix: str) -> Iterator[tuple[str, str]]:
    """Yield the name and the Arrow type of each column that is not a struct."""
    for field in fields:
        name = f"{prefix}{field.name}"
        if pt.is_struct(field.type) and field.type.num_fields:
            yield from _leaves(list(field.type), f"{name}.")
        else:
            yield name, str(field.type) if field.nullable else f"{field.type} not null"


def _topic_differences(name: str, lock: LockDocument, actual: LockDocument) -> Iterator[LockDifference]:
    old, new = lock.topics[name], actual.topics[name]
    at = ("topics", name)
    if old.type != new.type:
        yield LockDifference(Change.CHANGED_TYPE, name, f"{old.type} → {new.type}", (*at, "type"))
    else:
        old_types, new_types = lock.definitions[old.definition], actual.definitions[new.definition]
        yield from _type_differences(name, old_types, new_types, ("definitions", old.definition))
    if old.ontology != new.ontology:
        yield LockDifference(
            Change.CHANGED_ONTOLOGY, name, f"{old.ontology} → {new.ontology}", (*at, "ontology")
        )
    yield from _column_differences(name, old.columns, new.columns, (*at, "columns"))


def _type_differences(topic: str, old: Types, new: Types, path: KeyPath) -> Iterator[LockDifference]:
    for name in sorted({*old, *new}):
        if name not in new:
            yield LockDifference(Change.MISSING_TYPE, topic, name, (*path, name))
        elif name not in old:
            yield LockDifference(Change.NEW_TYPE, topic, name, path)
        elif old[name] != new[name]:
            yield from _line_differences(topic, name, old[name], new[name], (*path, name))


class _Line(Struct, frozen=True):
    """A line of a definition."""

    name: str
    text: str
    """The type of a field, or the type and the value of a constant."""
    position: int

    @classmethod
    def split(cls, lines: Sequence[str]) -> tuple[dict[str, _Line], dict[str, _Line]]:
        """Return the constants and the fields of a type by name."""
        constants: dict[str, _Line] = {}
        fields: dict[str, _Line] = {}
        for position, line in enumerate(lines):
            kind, _, rest = line.partition(" ")
            name, is_constant, value = rest.partition("=")
            if is_constant:
                constants[name] = cls(name, f"{kind} {value}", position)
            else:
                fields[name] = cls(name, kind, position)
        return constants, fields


def _line_differences(
    topic: str, msgtype: str, old: Sequence[str], new: Sequence[str], path: KeyPath
) -> Iterator[LockDifference]:
    """Yield the differences of the constants and fields of one type."""
    (old_constants, old_fields), (new_constants, new_fields) = _Line.split(old), _Line.split(new)
    for name in dict.fromkeys((*old_constants, *new_constants)):
        before, after = old_constants.get(name), new_constants.get(name)
        full = f"{msgtype}.{name}"
        if before is None and after is not None:
            yield LockDifference(Change.NEW_CONSTANT, topic, f"{full} = {after.text}", path)
        elif before is not None and after is None:
            at = (*path, before.position)
            yield LockDifference(Change.MISSING_CONSTANT, topic, f"{full} = {before.text}", at)
        elif before is not None and after is not None and before.text != after.text:
            text = f"{full}: {before.text} → {after.text}"
            yield LockDifference(Change.CHANGED_CONSTANT, topic, text, (*path, before.position))
    yield from _field_differences(topic, msgtype, old_fields, new_fields, path)


def _field_differences(
    topic: str, msgtype: str, old: Mapping[str, _Line], new: Mapping[str, _Line], path: KeyPath
) -> Iterator[LockDifference]:
    renamed = _renamed(old, new)
    for name, line in old.items():
        full, at = f"{msgtype}.{name}", (*path, line.position)
        if name in renamed:
            yield LockDifference(Change.RENAMED_FIELD, topic, f"{full} → {renamed[name]}", at)
        elif name not in new:
            yield LockDifference(Change.MISSING_FIELD, topic, f"{full}: {line.text}", at)
        elif new[name].text != line.text:
            yield LockDifference(Change.CHANGED_FIELD, topic, f"{full}: {line.text} → {new[name].text}", at)
    for name, line in new.items():
        if name not in old and name not in renamed.values():
            yield LockDifference(Change.NEW_FIELD, topic, f"{msgtype}.{name}: {line.text}", path)
    for name, before, after in _moved(list(old), list(new)):
        text = f"{msgtype}.{name}: position {before + 1} → {after + 1}"
        yield LockDifference(Change.MOVED_FIELD, topic, text, (*path, old[name].position))


def _renamed(old: Mapping[str, _Line], new: Mapping[str, _Line]) -> dict[str, str]:
    """Return the new names of fields that keep their type and position."""
    old_names, new_names = list(old), list(new)
    pairs = zip(old_names, new_names, strict=False)
    return {
        before: after
        for before, after in pairs
        if before not in new and after not in old and old[before].text == new[after].text
    }


def _moved(old: Sequence[str], new: Sequence[str]) -> Iterator[tuple[str, int, int]]:
    """Yield the names whose position among the common names differs, with both positions."""
    common = [name for name in old if name in new]
    reordered = [name for name in new if name in old]
    for name, other in zip(common, reordered, strict=True):
        if name != other:
            yield name, old.index(name), new.index(name)


def _column_differences(
    topic: str, old: Mapping[str, str], new: Mapping[str, str], path: KeyPath
) -> Iterator[LockDifference]:
    for name, kind in old.items():
        at = (*path, name)
        if name not in new:
            yield LockDifference(Change.MISSING_COLUMN, topic, f"{name}: {kind}", at)
        elif new[name] != kind:
            yield LockDifference(Change.CHANGED_COLUMN, topic, f"{name}: {kind} → {new[name]}", at)
    for name, kind in new.items():
        if name not in old:
            yield LockDifference(Change.NEW_COLUMN, topic, f"{name}: {kind}", path)
    for name, before, after in _moved(list(old), list(new)):
        text = f"{name}: position {before + 1} → {after + 1}"
        yield LockDifference(Change.MOVED_COLUMN, topic, text, (*path, name))


def _span(spans: Mapping[KeyPath, Span], key_spans: Mapping[KeyPath, Span], path: KeyPath) -> Span | None:
    """Return the span of the key or list item at a path, or of the nearest entry around it."""
    around = (path[:length] for length in range(len(path), 0, -1))
    return next(filter(None, (key_spans.get(entry) or spans.get(entry) for entry in around)), None)


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
        earlier = next((definition for definition in reference if definition.text != text), None)
        if earlier is None or text is None:
            topics.append(topic)
            continue
        target = _versioned_name(topic.target, text) if action is OnSchemaChange.NEW_TOPIC else topic.target
        topics.append(topic.replace(target=target))
        findings.append(_finding(topic, earlier, text, action, target))
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
