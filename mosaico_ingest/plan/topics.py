"""This file decides what becomes of one channel: left out and why, or which adapter, name and columns it gets."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

from mosaico_ingest.adapters.metadata import ros_metadata
from mosaico_ingest.bag.batch import Channel, Encoding
from mosaico_ingest.bag.definition import Definition
from mosaico_ingest.bag.shape import ros_shape
from mosaico_ingest.bridge import ROSBridge
from mosaico_ingest.config import ROSInjectionConfig
from mosaico_ingest.diagnostics import Finding, Severity, Span
from mosaico_ingest.errors import AdapterError, BagError
from mosaico_ingest.patterns import Selection, first_match
from mosaico_ingest.plan.model import LeftOut, TopicPlan
from mosaico_ingest.policies import LoaderErrorPolicy, Unmodeled

__all__ = ["decide", "merge"]

T = TypeVar("T")


def decide(
    config: ROSInjectionConfig, channel: Channel, selection: Selection, bridge: ROSBridge, source_file: str
) -> TopicPlan | LeftOut:
    """Return the plan for one channel, or why it is left out.

    Raises:
        AdapterError: An override does not fit, or the type has no adapter and the job says to fail then.
        BagError: Nobody defines the type, and unreadable messages shall end the run.
    """
    if channel.topic not in selection.selected:
        return _not_selected(config, channel, selection)
    if channel.encoding is Encoding.OTHER:
        encoding = channel.attributes.get("encoding", "unknown")
        return _left_out(channel, channel.problem or f"not a ROS encoding: {encoding}")
    if channel.definition is None:
        return _lost(config, channel, channel.problem or f"no definition of {channel.msgtype} is known")
    found = bridge.resolve(channel.topic, channel.msgtype)
    if found.unmodeled and config.unmodeled is not Unmodeled.KEEP:
        if config.unmodeled is Unmodeled.FAIL:
            raise AdapterError(
                f"no adapter takes {channel.msgtype}",
                where=channel.topic,
                hint="name one in adapters.override, or set adapters.unmodeled to keep or skip",
            )
        place = config.places.get(("adapters", "unmodeled"))
        return _left_out(
            channel, f"no adapter takes {channel.msgtype}, and adapters.unmodeled is skip", place
        )
    bound = found.spec.bind(channel.definition, ros_shape(channel.definition))
    metadata = {
        **_setting(config.topic_metadata, channel.topic, {}),
        **ros_metadata(channel.definition, source_file),
    }
    return TopicPlan(
        topic=channel.topic,
        target=config.rename.get(channel.topic, channel.topic),
        msgtype=channel.msgtype,
        channels=(channel.id,),
        adapter=found.spec,
        why=found.why,
        ontology=bound.ontology,
        count=channel.count,
        metadata=metadata,
        on_error=config.topic_policy(channel.topic),
        every=_setting(config.every, channel.topic, 1),
        definitions=(_definition(channel.definition),),
    )


def _definition(definition: Definition) -> str:
    return f"{definition.source.value} {hashlib.sha256(definition.text.encode()).hexdigest()[:16]}"


def merge(taken: list[TopicPlan], more: TopicPlan) -> Finding | None:
    """Add a channel's plan: to the stream with the same topic and columns, else as a stream of its own."""
    same_name = [plan for plan in taken if _bare(plan.target) == _bare(more.target)]
    for position, plan in enumerate(taken):
        same = plan.target == more.target and plan.msgtype == more.msgtype and plan.ontology == more.ontology
        if same and plan.topic == more.topic:
            count = None if plan.count is None or more.count is None else plan.count + more.count
            taken[position] = replace(
                plan,
                channels=(*plan.channels, *more.channels),
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
        return "two-types-on-a-topic", f"{second.topic} carries {first.msgtype} and {second.msgtype}"
    return "two-types-on-a-topic", f"{second.topic} carries two definitions of {second.msgtype}"


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


def _left_out(channel: Channel, why: str, place: Span | None = None) -> LeftOut:
    return LeftOut(channel.topic, channel.msgtype, channel.count, why, place)


def _lost(config: ROSInjectionConfig, channel: Channel, why: str) -> LeftOut:
    if channel.count != 0 and config.messages_on_error is LoaderErrorPolicy.RAISE:
        raise BagError(why, where=channel.topic)
    return replace(_left_out(channel, why), lost=channel.count != 0)


def _not_selected(config: ROSInjectionConfig, channel: Channel, selection: Selection) -> LeftOut:
    position = selection.decided_by[channel.topic]
    if position is None:
        return _left_out(channel, "no pattern of `topics` matches it", config.places.get(("topics",)))
    why = f"left out by {(config.topics or ())[position]!r} in `topics`"
    return _left_out(channel, why, config.places.get(("topics", position)))
