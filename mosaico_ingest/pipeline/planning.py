"""Make the plan of one recording: compare its configuration with the recording and decide everything."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from difflib import get_close_matches, unified_diff
from typing import Any, TypeVar, cast

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.adapter import ROS_METADATA_KEY, ros_metadata
from mosaico_ingest.adapters.bridge import ROSBridge
from mosaico_ingest.adapters.image import IMAGE_TAG
from mosaico_ingest.destinations.registry import destination_of
from mosaico_ingest.errors import AdapterError, BagError, IngestError, NothingMatched
from mosaico_ingest.findings import (
    Finding,
    Severity,
    Span,
    escape_undecodable,
    suggest_names,
)
from mosaico_ingest.job.config import ROSInjectionConfig, TimeRange
from mosaico_ingest.job.patterns import Selection, first_match, select
from mosaico_ingest.job.values import (
    DEFAULT_TOPIC,
    PROVENANCE_KEY,
    LoaderErrorPolicy,
    OnSchemaChange,
    Target,
    TimeBound,
    Unmodeled,
)
from mosaico_ingest.pipeline.memory import DEFAULT_BYTES, MemoryBudget
from mosaico_ingest.pipeline.plan import (
    ExcludedTopic,
    Plan,
    TopicPlan,
    check_digest,
)
from mosaico_ingest.protocol import check_topic_name
from mosaico_ingest.rosbag.blocks import Connection, Encoding
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.recording import Recording, no_topics_error

__all__ = [
    "decide",
    "follow_schema_changes",
    "merge",
    "resolve",
]

T = TypeVar("T")


def decide(
    config: ROSInjectionConfig,
    connection: Connection,
    selection: Selection,
    bridge: ROSBridge,
    source_file: str,
) -> TopicPlan | ExcludedTopic:
    """Return the plan for one connection, or why it is left out.

    Raises:
        AdapterError: An override does not fit, or the type has no adapter and the job says to fail then.
        BagError: Nobody defines the type, and unreadable messages shall end the run.
    """
    if connection.topic not in selection.selected:
        return _not_selected(config, connection, selection)
    if connection.encoding is Encoding.OTHER:
        encoding = connection.attributes.get("encoding", "unknown")
        return _excluded(connection, connection.problem or f"not a ROS encoding: {encoding}")
    if connection.definition is None:
        return _lost(
            config, connection, connection.problem or f"no definition of {connection.msgtype} is known"
        )
    found = bridge.resolve(connection.topic, connection.msgtype)
    if found.unmodeled and config.unmodeled is not Unmodeled.KEEP:
        if config.unmodeled is Unmodeled.FAIL:
            raise AdapterError(
                f"no adapter takes {connection.msgtype}",
                where=connection.topic,
                hint="name one in adapters.override, or set adapters.unmodeled to keep or skip",
            )
        place = config.places.get(("adapters", "unmodeled"))
        return _excluded(
            connection, f"no adapter takes {connection.msgtype}, and adapters.unmodeled is skip", place
        )
    bound = found.spec.bind(connection.definition, ros_shape(connection.definition))
    metadata = {
        **_setting(config.topic_metadata, connection.topic, {}),
        **ros_metadata(connection.definition, source_file),
    }
    return TopicPlan(
        topic=connection.topic,
        target=config.rename.get(connection.topic, connection.topic),
        msgtype=connection.msgtype,
        connections=(connection.id,),
        adapter=found.spec,
        why=found.why,
        ontology=bound.ontology,
        count=connection.count,
        metadata=metadata,
        on_error=config.topic_policy(connection.topic),
        every=_setting(config.every, connection.topic, 1),
        definitions=(_definition(connection.definition),),
    )


def _definition(definition: Definition) -> str:
    return f"{definition.source.value} {hashlib.sha256(definition.text.encode()).hexdigest()[:16]}"


def merge(taken: list[TopicPlan], more: TopicPlan) -> Finding | None:
    """Add a connection's plan: to the stream with the same topic and columns, else as a stream of its own."""
    same_name = [plan for plan in taken if _bare(plan.target) == _bare(more.target)]
    for position, plan in enumerate(taken):
        same = plan.target == more.target and plan.msgtype == more.msgtype and plan.ontology == more.ontology
        if same and plan.topic == more.topic:
            count = None if plan.count is None or more.count is None else plan.count + more.count
            taken[position] = replace(
                plan,
                connections=(*plan.connections, *more.connections),
                count=count,
                definitions=tuple(dict.fromkeys((*plan.definitions, *more.definitions))),
            )
            return None
    if not same_name:
        taken.append(more)
        return None
    target = _free_name(more, {_bare(plan.target) for plan in taken})
    taken.append(replace(more, target=target))
    rule, what = _clash(same_name[0], more)
    return Finding(rule, Severity.WARNING, what, help=f"the second one is stored as {target}")


def _clash(first: TopicPlan, second: TopicPlan) -> tuple[str, str]:
    """Return the rule and the words for two streams of one name."""
    if first.topic != second.topic:
        return "name-clash", f"{first.topic} and {second.topic} have one name in the sequence, {first.target}"
    if first.msgtype != second.msgtype:
        return "mixed-types", f"{second.topic} carries {first.msgtype} and {second.msgtype}"
    return "mixed-types", f"{second.topic} carries two definitions of {second.msgtype}"


def _bare(name: str) -> str:
    """Return a topic's name as the destination knows it: with or without the first slash it is one."""
    return name.removeprefix("/")


def _setting(settings: Mapping[str, T], topic: str, default: T) -> T:
    match = first_match(settings, topic)
    return default if match is None else settings[match]


def _free_name(plan: TopicPlan, used: set[str]) -> str:
    base = f"{plan.target}/{plan.msgtype.rpartition('/')[2]}"
    candidates = (base, *(f"{base}_{number}" for number in range(2, len(used) + 3)))
    return next(name for name in candidates if _bare(name) not in used)


def _excluded(connection: Connection, why: str, place: Span | None = None) -> ExcludedTopic:
    return ExcludedTopic(connection.topic, connection.msgtype, connection.count, why, place)


def _lost(config: ROSInjectionConfig, connection: Connection, why: str) -> ExcludedTopic:
    if connection.count != 0 and config.messages_on_error is LoaderErrorPolicy.RAISE:
        raise BagError(why, where=connection.topic)
    return replace(_excluded(connection, why), undefined=connection.count != 0)


def _not_selected(config: ROSInjectionConfig, connection: Connection, selection: Selection) -> ExcludedTopic:
    position = selection.decided_by[connection.topic]
    if position is None:
        return _excluded(connection, "no pattern of `topics` matches it", config.places.get(("topics",)))
    why = f"left out by {(config.topics or ())[position]!r} in `topics`"
    return _excluded(connection, why, config.places.get(("topics", position)))


class _Known(Struct, frozen=True):
    """A definition that a sequence of the family has for a topic."""

    sequence: str
    text: str


def follow_schema_changes(plan: Plan, wanted: OnSchemaChange) -> Plan:
    """Return the plan with what there is to say about changed definitions, and with topics renamed where wanted.

    Raises:
        IngestError: A definition has changed and the job says to fail then; `findings` has every difference.
    """
    known = _known_definitions(plan.target, plan.family)
    if known is None:
        unchecked = Finding(
            "schema-change-unchecked",
            Severity.WARNING,
            "on_schema_change is for stores: a server is not asked for the definitions it has",
        )
        return replace(plan, findings=(*plan.findings, unchecked))
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


def _known_definitions(target: Target, family: str | None) -> dict[str, list[_Known]] | None:
    """Return the stored definitions by topic in the order of the family's sessions, or None if they cannot be listed."""
    sequences = destination_of(target).sequences()
    if sequences is None:
        return None
    found: dict[str, list[tuple[str, _Known]]] = {}
    for sequence in sequences:
        sessions = {one.id for one in sequence.sessions if _family(one.metadata) == family}
        for name, topic in sequence.topics.items():
            text = _text(topic.metadata)
            if topic.session in sessions and text is not None:
                found.setdefault(name, []).append((topic.session, _Known(sequence.name, text)))
    return {
        name: [known for _, known in sorted(history, key=lambda one: one[0])]
        for name, history in found.items()
    }


def _family(metadata: Mapping[str, Any]) -> object:
    return _member(metadata.get(PROVENANCE_KEY), "family")


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


def resolve(
    config: ROSInjectionConfig, recording: Recording, *, bridge: ROSBridge, resolver: TypeResolver
) -> Plan:
    """Decide what becomes of each topic of the recording.

    Raises:
        NothingMatched: No topic is left, or the recording has no message.
        BagError: Nobody defines a topic's type, and unreadable messages shall end the run.
        AdapterError: An adapter does not fit its topic, or a type without adapter is not wanted; `findings` has
            every mistake of every topic.
        IngestError: The configuration is for one plan only, and this is another.
    """
    topics = tuple(dict.fromkeys(connection.topic for connection in recording.connections))
    selection = select(config.topics or (), topics)
    findings = [*_known(recording, resolver, selection), *_findings(config, selection, topics)]
    taken: list[TopicPlan] = []
    left: list[ExcludedTopic] = []
    misfits: list[tuple[str, AdapterError]] = []
    for connection in recording.connections:
        try:
            outcome = decide(
                config, connection, selection, bridge, escape_undecodable(recording.files[0].name)
            )
        except AdapterError as error:
            misfits.append((connection.topic, error))
            continue
        if isinstance(outcome, ExcludedTopic):
            left.append(outcome)
        elif (finding := merge(taken, outcome)) is not None:
            findings.append(finding)
    if misfits:
        raise _misfit(config, misfits)
    if not taken:
        raise _nothing(config, recording, left)
    findings += _image_settings(config, taken)
    read_from_ns, read_until_ns = _window(config.time_range, recording)
    plan = Plan(
        files=recording.files,
        container=recording.container,
        source_bytes=recording.size_bytes,
        resolver=resolver,
        sequence=config.sequence_name,
        metadata=config.metadata,
        target=config.target,
        if_exists=config.if_exists,
        on_error=config.on_error,
        on_message_error=config.messages_on_error,
        topics=tuple(taken),
        excluded=tuple(left),
        findings=tuple(findings),
        start_ns=recording.start_ns,
        end_ns=recording.end_ns,
        read_from_ns=read_from_ns,
        read_until_ns=read_until_ns,
        quarantine=config.quarantine,
        missing=recording.missing_files,
        family=config.family or config.sequence_name,
        memory=MemoryBudget(config.memory_bytes or DEFAULT_BYTES),
        attempt=config.attempt,
    )
    if config.on_schema_change is not None:
        plan = follow_schema_changes(plan, config.on_schema_change)
    check_digest(plan, config)
    return plan


def _known(recording: Recording, resolver: TypeResolver, selection: Selection) -> Iterator[Finding]:
    """Yield what is odd about the recording and the types that are taken; `merge` tells of two types on a topic."""
    yield from (finding for finding in recording.findings if finding.rule != "mixed-types")
    taken = [connection for connection in recording.connections if connection.topic in selection.selected]
    yield from resolver.findings_about(
        {name for connection in taken if connection.definition for name in connection.definition.types}
    )


def _window(wanted: TimeRange, recording: Recording) -> tuple[int | None, int | None]:
    """Return from and until when to read, ns since the epoch."""

    def instant(bound: TimeBound | None) -> int | None:
        if bound is None or not bound.relative:
            return bound.ns if bound else None
        if recording.start_ns is None or recording.end_ns is None:
            raise BagError(
                "the recording has no index, so it is not known when it begins and ends",
                where=str(recording.files[0]),
                hint="give bag.time as instants, not as offsets",
            )
        return bound.at(recording.start_ns, recording.end_ns)

    return instant(wanted.start), instant(wanted.end)


def _misfit(config: ROSInjectionConfig, misfits: list[tuple[str, AdapterError]]) -> AdapterError:
    """Return one error for all topics whose adapters do not fit."""
    findings: dict[Finding, None] = {}
    for topic, error in misfits:
        glob = first_match(config.adapter_override, topic)
        place = config.places.get(("adapters", "override", glob))
        said = f"{error.where}: {error.what}" if error.where else error.what
        own = Finding("type-mismatch", Severity.ERROR, said, place, error.hint)
        findings.update(dict.fromkeys(error.findings or (own,)))
    first = misfits[0][1]
    more = f" (and {len(misfits) - 1} more topics)" if len(misfits) > 1 else ""
    return AdapterError(f"{first.what}{more}", where=first.where, hint=first.hint, findings=tuple(findings))


def _findings(config: ROSInjectionConfig, selection: Selection, topics: tuple[str, ...]) -> Iterator[Finding]:
    """Yield what the configuration names that the recording does not have."""
    patterns = config.topics or ()
    for position in selection.unused:
        yield _no_match("topics", patterns[position], topics, config.places.get(("topics", position)))
    settings = dict.fromkeys((*config.topic_metadata, *config.images, *config.rename, *config.every))
    policies = config.topics_on_error if isinstance(config.topics_on_error, Mapping) else {}
    keyed: tuple[tuple[tuple[str, ...], Iterable[str]], ...] = (
        (("topic_settings",), settings),
        (("adapters", "override"), config.adapter_override),
        (("on_error", "topic"), (glob for glob in policies if glob != DEFAULT_TOPIC)),
    )
    for section, globs in keyed:
        for glob in globs:
            if not any(first_match((glob,), topic) for topic in topics):
                yield _no_match(".".join(section), glob, topics, config.places.get((*section, glob)))


def _image_settings(config: ROSInjectionConfig, topics: Iterable[TopicPlan]) -> Iterator[Finding]:
    """Yield a finding for each `image: png` whose pattern applies only to topics that do not become images."""
    tags: dict[str, dict[str, str]] = {}
    for topic in topics:
        pattern = first_match(config.images, topic.topic)
        if pattern is not None and config.images[pattern] == "png":
            tags.setdefault(pattern, {})[topic.topic] = topic.ontology.tag
    for pattern, by_topic in tags.items():
        if IMAGE_TAG not in by_topic.values():
            topic, tag = next(iter(by_topic.items()))
            yield Finding(
                "image-setting",
                Severity.WARNING,
                f"image: png has no effect, because {topic} becomes {tag}, not {IMAGE_TAG}",
                config.places.get(("topic_settings", pattern, "image")),
                "remove the setting",
            )


def _no_match(key: str, glob: str, topics: tuple[str, ...], place: Span | None) -> Finding:
    near = get_close_matches(glob.lstrip("!"), topics, n=1, cutoff=0.5)
    return Finding(
        "unmatched-pattern",
        Severity.WARNING,
        f"{key}: {glob!r} matches none of {len(topics)} topics",
        place,
        f"the nearest is {near[0]}" if near else None,
    )


def _nothing(
    config: ROSInjectionConfig, recording: Recording, left: list[ExcludedTopic]
) -> NothingMatched | BagError:
    where = str(recording.files[0])
    if not left:
        return no_topics_error(recording)
    if config.topics and all("`topics`" in one.why for one in left):
        what = f"no topic matches {', '.join(map(repr, config.topics))}"
        return NothingMatched(
            where=where, what=what, hint=suggest_names({one.topic for one in left}, config.topics)
        )
    first = left[0]
    return NothingMatched(
        f"none of {len(left)} topics can be ingested", where=where, hint=f"{first.topic}: {first.why}"
    )
