"""Comparison of the messages of two recordings, field by field."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mosaico_ingest.rosbag.loader import ROSLoader


def messages_of(path: Path, **options: Any) -> dict[str, list[tuple[int, dict[str, Any]]]]:
    """Return log time and content of the messages of each topic; unreadable messages are skipped."""
    messages_by_topic: dict[str, list[tuple[int, dict[str, Any]]]] = defaultdict(list)
    with ROSLoader(path, error_policy="ignore", **options) as loader:
        for message, error in loader:
            if error is None:
                messages_by_topic[message.topic].append((message.bag_timestamp_ns, message.data))
    return dict(messages_by_topic)


def differing(left: Any, right: Any, at: str = "") -> Iterator[str]:
    """Yield the fields in which two messages differ, such as `header.stamp` or `poses[].position`."""
    if isinstance(left, dict) and isinstance(right, dict):
        for name in left.keys() | right.keys():
            yield from differing(left.get(name), right.get(name), f"{at}.{name}" if at else name)
    elif isinstance(left, (list, tuple)) and isinstance(right, (list, tuple)):
        if len(left) != len(right):
            yield at
        for one, other in zip(left, right, strict=False):
            yield from differing(one, other, at if not isinstance(one, dict) else f"{at}[]")
    elif isinstance(left, float) and isinstance(right, float) and math.isnan(left) and math.isnan(right):
        return
    elif left != right:
        yield at


def differences(source: Path, written: Path, **options: Any) -> dict[str, set[str]]:
    """Return the differing fields per topic; `(count)` and `(time)` if numbers or log times of messages differ."""
    before, after = messages_of(source, **options), messages_of(written)
    fields_by_topic: dict[str, set[str]] = {}
    for topic, messages in before.items():
        others = after.get(topic, [])
        fields = set() if len(messages) == len(others) else {"(count)"}
        for (time, one), (other_time, other) in zip(messages, others, strict=False):
            fields |= set(differing(one, other)) | ({"(time)"} if time != other_time else set())
        if fields:
            fields_by_topic[topic] = fields
    return fields_by_topic
