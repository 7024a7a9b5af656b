"""This file makes the plan: it holds a configuration against the recording and decides everything."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from difflib import get_close_matches

from mosaico_ingest.bag.recording import Recording
from mosaico_ingest.bag.types import TypeResolver
from mosaico_ingest.bridge import ROSBridge
from mosaico_ingest.config import DEFAULT_TOPIC, ROSInjectionConfig, TimeBound, TimeRange
from mosaico_ingest.diagnostics import Finding, Severity, Span, encodable, offered
from mosaico_ingest.errors import AdapterError, BagError, NothingMatched
from mosaico_ingest.patterns import Selection, first_match, select
from mosaico_ingest.plan.describe import check_digest
from mosaico_ingest.plan.model import DEFAULT_MEMORY_BYTES, LeftOut, Plan, TopicPlan
from mosaico_ingest.plan.schema_change import follow_schema_changes
from mosaico_ingest.plan.topics import decide, merge

__all__ = ["resolve"]


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
    topics = tuple(dict.fromkeys(channel.topic for channel in recording.channels))
    selection = select(config.topics or (), topics)
    findings = [*_known(recording, resolver, selection), *_findings(config, selection, topics)]
    taken: list[TopicPlan] = []
    left: list[LeftOut] = []
    misfits: list[tuple[str, AdapterError]] = []
    for channel in recording.channels:
        try:
            outcome = decide(config, channel, selection, bridge, encodable(recording.files[0].name))
        except AdapterError as error:
            misfits.append((channel.topic, error))
            continue
        if isinstance(outcome, LeftOut):
            left.append(outcome)
        elif (finding := merge(taken, outcome)) is not None:
            findings.append(finding)
    if misfits:
        raise _misfit(config, misfits)
    if not taken:
        raise _nothing(config, recording, left)
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
        left_out=tuple(left),
        findings=tuple(findings),
        start_ns=recording.start_ns,
        end_ns=recording.end_ns,
        read_from_ns=read_from_ns,
        read_until_ns=read_until_ns,
        quarantine=config.quarantine,
        missing=recording.missing,
        family=config.family or config.sequence_name,
        memory_bytes=config.memory_bytes or DEFAULT_MEMORY_BYTES,
        attempt=config.attempt,
    )
    if config.on_schema_change is not None:
        plan = follow_schema_changes(plan, config.on_schema_change)
    check_digest(plan, config)
    return plan


def _known(recording: Recording, resolver: TypeResolver, selection: Selection) -> Iterator[Finding]:
    """Yield what is odd about the recording and the types that are taken; `merge` tells of two types on a topic."""
    yield from (finding for finding in recording.findings if finding.rule != "two-types")
    taken = [channel for channel in recording.channels if channel.topic in selection.selected]
    yield from resolver.findings_about(
        {name for channel in taken if channel.definition for name in channel.definition.types}
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
        own = Finding("misfit", Severity.ERROR, said, place, error.hint)
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


def _no_match(key: str, glob: str, topics: tuple[str, ...], place: Span | None) -> Finding:
    near = get_close_matches(glob.lstrip("!"), topics, n=1, cutoff=0.5)
    return Finding(
        "matches-nothing",
        Severity.WARNING,
        f"{key}: {glob!r} matches none of {len(topics)} topics",
        place,
        f"the nearest is {near[0]}" if near else None,
    )


def _nothing(config: ROSInjectionConfig, recording: Recording, left: list[LeftOut]) -> NothingMatched:
    where = str(recording.files[0])
    if not left:
        return NothingMatched("the recording has no topic", where=where)
    if config.topics and all("`topics`" in one.why for one in left):
        what = f"no topic matches {', '.join(map(repr, config.topics))}"
        return NothingMatched(
            where=where, what=what, hint=offered({one.topic for one in left}, config.topics)
        )
    first = left[0]
    return NothingMatched(
        f"none of {len(left)} topics can be ingested", where=where, hint=f"{first.topic}: {first.why}"
    )
