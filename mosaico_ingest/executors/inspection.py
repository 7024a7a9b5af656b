"""This file looks into a recording for `ingest inspect`: its index, its definitions, the adapters it would get."""

from __future__ import annotations

from mosaico_ingest.bag.batch import Channel
from mosaico_ingest.bridge import ROSBridge
from mosaico_ingest.config import ROSInjectionConfig
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.executors.worker import open_for
from mosaico_ingest.patterns import select
from mosaico_ingest.plan.model import LeftOut
from mosaico_ingest.plan.topics import decide
from mosaico_ingest.report.inspection import InspectedTopic, Inspection

__all__ = ["inspect"]


def inspect(config: ROSInjectionConfig) -> Inspection:
    """Open the recording and describe it.

    Raises:
        BagError: It cannot be opened.
    """
    bridge = ROSBridge.for_config(config)
    with open_for(config) as (recording, _):
        duration_ns = None
        if recording.start_ns is not None and recording.end_ns is not None:
            duration_ns = recording.end_ns - recording.start_ns
        topics = [_topic(config, channel, bridge, duration_ns) for channel in recording.channels]
        return Inspection(
            files=tuple(str(path) for path in recording.files),
            container=recording.container,
            size_bytes=recording.size_bytes,
            messages=recording.message_count,
            start_ns=recording.start_ns,
            end_ns=recording.end_ns,
            topics=tuple(sorted(topics, key=lambda topic: topic.topic)),
            findings=tuple(str(finding) for finding in recording.findings),
        )


def _topic(
    config: ROSInjectionConfig, channel: Channel, bridge: ROSBridge, duration_ns: int | None
) -> InspectedTopic:
    try:
        outcome = decide(config, channel, select((), [channel.topic]), bridge, "")
    except AdapterError as error:
        outcome = LeftOut(channel.topic, channel.msgtype, channel.count, str(error))
    rate = None
    if channel.count and channel.count > 1 and duration_ns:
        rate = (channel.count - 1) / (duration_ns / 1e9)
    source = channel.definition.source.value if channel.definition else "none"
    left = isinstance(outcome, LeftOut)
    return InspectedTopic(
        topic=channel.topic,
        msgtype=channel.msgtype,
        encoding=channel.encoding.value,
        count=channel.count,
        rate_hz=rate,
        definition=source,
        adapter="" if left else outcome.adapter.name,
        ontology=None if left else outcome.ontology.tag,
        problem=outcome.why if left else None,
    )
