"""This file turns the streams of all parts into channels: one for each way a topic was written."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

from mosaico_ingest.bag.batch import Channel, Encoding
from mosaico_ingest.bag.containers.part import Part, Stream
from mosaico_ingest.bag.definition import Definition, Embedded, Resolver, Source
from mosaico_ingest.bag.hashes import difference
from mosaico_ingest.bag.names import normalize_msgtype
from mosaico_ingest.errors import BagError

__all__ = ["ChannelTable"]


@dataclass(slots=True)
class _Types:
    """Asks the resolver once for each type and text."""

    resolver: Resolver
    known: dict[tuple[str, Embedded | None, int], Definition | str] = field(
        default_factory=dict[tuple[str, "Embedded | None", int], "Definition | str"]
    )

    def of(self, stream: Stream) -> Definition | str:
        """Return the stream's definition, or why there is none."""
        if stream.encoding is Encoding.OTHER:
            return (
                f"its messages are {stream.attributes.get('encoding', '')!r}, which is no ROS serialisation"
            )
        asked = (stream.msgtype, stream.embedded, stream.ros_version)
        if asked not in self.known:
            self.known[asked] = self._resolve(stream)
        found = self.known[asked]
        if isinstance(found, str) or found.source in {Source.BAG, Source.CUSTOM}:
            return found
        other = difference(found, stream.attributes)
        remedy = "give the right one with custom_msgs"
        return f"another definition of {found.root} is known: {other} — {remedy}" if other else found

    def _resolve(self, stream: Stream) -> Definition | str:
        try:
            return self.resolver.resolve(stream.msgtype, stream.embedded, ros_version=stream.ros_version)
        except BagError as err:
            return str(err)


class ChannelTable:
    """The channels of a recording, and which streams of which part they are made of."""

    def __init__(self, parts: Sequence[Part], resolver: Resolver) -> None:
        self._ids: dict[tuple[int, int], int] = {}
        self._found: list[Channel] = []
        self._of_topic: dict[str, list[int]] = defaultdict(list)
        types = _Types(resolver)
        for number, part in enumerate(parts):
            for stream in part.streams:
                self._ids[number, stream.key] = self._place(_channel(stream, types.of(stream)))
        self.channels: tuple[Channel, ...] = tuple(self._found)

    def channel_id(self, part: int, key: int) -> int:
        """Return the channel that a part's stream belongs to."""
        return self._ids[part, key]

    def keys(self, part: int, channels: Collection[int]) -> frozenset[int]:
        """Return the streams of a part that make up the channels."""
        return frozenset(
            key for (number, key), channel in self._ids.items() if number == part and channel in channels
        )

    def _place(self, channel: Channel) -> int:
        """Add to the channel that is written the same way, or open a new one."""
        for known in (self._found[number] for number in self._of_topic[channel.topic]):
            if _same(known, channel):
                count = None if known.count is None or channel.count is None else known.count + channel.count
                latched = known.latched or channel.latched
                self._found[known.id] = replace(known, count=count, latched=latched)
                return known.id
        self._of_topic[channel.topic].append(len(self._found))
        self._found.append(replace(channel, id=len(self._found)))
        return len(self._found) - 1


def _channel(stream: Stream, definition: Definition | str) -> Channel:
    is_known = isinstance(definition, Definition)
    return Channel(
        id=-1,
        topic=stream.topic,
        msgtype=definition.root if isinstance(definition, Definition) else normalize_msgtype(stream.msgtype),
        encoding=stream.encoding,
        count=stream.count,
        definition=definition if isinstance(definition, Definition) else None,
        problem=None if is_known else str(definition),
        latched=stream.latched or _is_transient_local(stream),
        attributes=stream.attributes,
    )


def _is_transient_local(stream: Stream) -> bool:
    """Return whether late subscribers get old messages too: what ROS 1 called latched."""
    return (
        re.search(r"durability:\s*(1|transient_local)\b", stream.attributes.get("offered_qos_profiles", ""))
        is not None
    )


def _same(one: Channel, other: Channel) -> bool:
    """Return whether two are written the same way; comments in a definition make no difference."""
    if (one.topic, one.msgtype, one.encoding, one.problem) != (
        other.topic,
        other.msgtype,
        other.encoding,
        other.problem,
    ):
        return False
    a, b = one.definition, other.definition
    if a is None or b is None:
        return a is b
    return a is b or (a.ros_version == b.ros_version and a.types == b.types)
