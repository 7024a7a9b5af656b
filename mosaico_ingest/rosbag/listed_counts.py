"""The comparison of a recording with the message counts in its `metadata.yaml`, which reveals missing messages."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence

from msgspec.structs import replace

from mosaico_ingest.rosbag.blocks import Connection, UnreadableRange
from mosaico_ingest.rosbag.discovery import RecordingFiles


def listed_counts(files: RecordingFiles) -> dict[str, int]:
    """Return the number of messages per topic in the metadata; empty if it does not describe exactly these files."""
    metadata = files.metadata
    if metadata is None or files.missing or len(files.files) != len(metadata.files):
        return {}
    counts: Counter[str] = Counter()
    for topic in metadata.topics:
        counts[topic.topic] += topic.count
    return dict(counts)


def add_missing_messages(
    connections: Sequence[Connection],
    listed_counts: Mapping[str, int],
    unreadable: Iterable[UnreadableRange],
    *,
    file: str,
) -> tuple[tuple[Connection, ...], list[UnreadableRange]]:
    """Return the connections with the counts of the metadata, and the messages that are listed but not in the index.

    Unreadable messages of unknown topics explain differences. Topics whose counts are unknown are compared after
    reading; see `missing_after_reading`.
    """
    explained = sum(item.count or 0 for item in unreadable if item.connection is None)
    new_connections = list(connections)
    missing: list[UnreadableRange] = []
    of_topic: dict[str, list[Connection]] = defaultdict(list)
    for connection in connections:
        of_topic[connection.topic].append(connection)
    for topic, count in listed_counts.items():
        counts = [connection.count for connection in of_topic[topic]]
        difference = count - sum(number or 0 for number in counts)
        if None in counts or difference <= explained:
            explained -= max(difference, 0) if None not in counts else 0
            continue
        difference, explained = difference - explained, 0
        first = of_topic[topic][0] if of_topic[topic] else None
        if first is not None:
            new_connections[first.id] = replace(first, count=(first.count or 0) + difference)
        missing.append(_missing(topic, count, difference, first, file))
    return tuple(new_connections), missing


def missing_after_reading(
    connections: Sequence[Connection],
    listed_counts: Mapping[str, int],
    read_counts: Mapping[int, int],
    unreadable: Iterable[UnreadableRange],
    *,
    file: str,
) -> list[UnreadableRange]:
    """Return the messages that are listed but were not read, for topics without an index; `read_counts` is by connection.

    Unreadable ranges of unknown size or topic already explain any difference.
    """
    unreadable_counts: Counter[int] = Counter()
    for item in unreadable:
        if item.count is None or (item.connection is None and item.count):
            return []
        if item.connection is not None:
            unreadable_counts[item.connection] += item.count
    missing: list[UnreadableRange] = []
    for topic, count in listed_counts.items():
        matching = [connection for connection in connections if connection.topic == topic]
        if not any(connection.count is None for connection in matching):
            continue
        difference = count - sum(
            read_counts.get(each.id, 0) + unreadable_counts[each.id] for each in matching
        )
        if difference > 0 and all(each.id in read_counts for each in matching):
            missing.append(_missing(topic, count, difference, matching[0], file))
    return missing


def _missing(
    topic: str, count: int, difference: int, connection: Connection | None, file: str
) -> UnreadableRange:
    reason = (
        f"the metadata lists {count} messages of {topic}, and {difference} of them are not in the recording"
    )
    return UnreadableRange(
        0, reason, connection=None if connection is None else connection.id, count=difference, file=file
    )
