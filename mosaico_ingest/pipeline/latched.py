"""Latched topics: their messages before a time range, which late subscribers would receive too."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

from mosaico_ingest.pipeline.plan import Plan
from mosaico_ingest.rosbag.blocks import MessageBlock
from mosaico_ingest.rosbag.recording import Recording


def is_static(topic: str) -> bool:
    """Return whether all messages of a topic stay valid: each publisher sends its own static transforms."""
    return topic.rpartition("/")[2] == "tf_static"


def latched_blocks(plan: Plan, recording: Recording) -> Iterator[MessageBlock]:
    """Yield the messages before the time range to include: the latest one of each latched connection, all static ones.

    The messages of a connection are in log-time order.
    """
    static = {
        connection: is_static(topic.topic)
        for topic in plan.topics
        if topic.latched
        for connection in topic.connections
    }
    if plan.read_from_ns is None or not static:
        return
    latest: dict[int, MessageBlock] = {}
    early: dict[int, list[MessageBlock]] = defaultdict(list)
    for block in recording.message_blocks(
        tuple(static), end_ns=plan.read_from_ns, memory_bytes=plan.memory.read_bytes
    ):
        if static[block.connection]:
            early[block.connection].append(block)
            continue
        last = block.rows(slice(len(block) - 1, None))
        known = latest.get(block.connection)
        if known is None or last.log_times[0] >= known.log_times[0]:
            latest[block.connection] = last
    for connection in static:
        yield from early[connection]
        if connection in latest:
            yield latest[connection]
