"""Latched topics: their messages before a time range, which late subscribers would receive too."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator

from mosaico_ingest.pipeline.plan import Plan
from mosaico_ingest.rosbag.blocks import Int64s, MessageBlock
from mosaico_ingest.rosbag.recording import Recording


def is_static(topic: str) -> bool:
    """Return whether all messages of a topic stay valid: each publisher sends its own static transforms."""
    return topic.rpartition("/")[2] == "tf_static"


def latched_blocks(
    plan: Plan, recording: Recording, times_of: Callable[[MessageBlock], Int64s]
) -> Iterator[MessageBlock]:
    """Yield the messages before the time range to include: the latest message of each latched connection, and all static messages.

    The messages of a connection are in log-time order. `times_of` returns the selected times of the messages of a block;
    a message is before the time range if its selected time is.
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
    for block in _early_blocks(plan, recording, static, times_of):
        if static[block.connection]:
            early[block.connection].append(block)
            continue
        last = block.rows(slice(len(block) - 1, None))
        previous = latest.get(block.connection)
        if previous is None or last.log_times[0] >= previous.log_times[0]:
            latest[block.connection] = last
    for connection in static:
        yield from early[connection]
        if connection in latest:
            yield latest[connection]


def _early_blocks(
    plan: Plan, recording: Recording, static: dict[int, bool], times_of: Callable[[MessageBlock], Int64s]
) -> Iterator[MessageBlock]:
    """Yield the messages of some connections before the time range; with an index, at least the latest message of each."""
    if plan.read_from_ns is None or not plan.selects_after_reading:
        yield from _latest_blocks(plan, recording, static)
        return
    for block in recording.message_blocks(tuple(static), memory_bytes=plan.memory.read_bytes):
        is_early = times_of(block) < plan.read_from_ns
        if is_early.any():
            yield block.rows(is_early)


def _latest_blocks(plan: Plan, recording: Recording, static: dict[int, bool]) -> Iterator[MessageBlock]:
    """Yield messages before the log time at which the range starts; the index has the log time of the latest one."""
    single = [connection for connection, is_all in static.items() if not is_all]
    times = recording.index_times(single, end_ns=plan.read_from_ns) if single else {}
    complete = [connection for connection, is_all in static.items() if is_all or times is None]
    for connection, log_times in (times or {}).items():
        if not len(log_times):
            continue
        latest_ns = int(log_times[-1])
        blocks = list(recording.message_blocks((connection,), start_ns=latest_ns, end_ns=latest_ns + 1))
        yield from blocks
        if not blocks:  # the latest message is unreadable
            complete.append(connection)
    if complete:
        yield from recording.message_blocks(
            complete, end_ns=plan.read_from_ns, memory_bytes=plan.memory.read_bytes
        )
