"""Recordings of messages with a header stamp and a value, and a strategy for them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hypothesis import strategies as st
from made_recordings import define, record

SECOND = 10**9
START_NS = 1_700_000_000 * SECOND
STAMPED = define(
    "test_msgs/msg/Stamped",
    "std_msgs/Header header\nint32 value\n"
    "================================================================================\n"
    "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    "================================================================================\n"
    "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
)

Messages = Sequence[tuple[str, int, int]]
"""Topic, log time after `START_NS` and header stamp of each message, both in ns; its value is its position."""

MESSAGES = st.lists(
    st.tuples(
        st.sampled_from(["/a", "/b"]),
        st.integers(0, 6 * SECOND),
        st.just(0) | st.integers(START_NS - SECOND, START_NS + 8 * SECOND),
    ),
    min_size=1,
    max_size=24,
)


def stamped(value: int, stamp_ns: int) -> dict[str, Any]:
    stamp = {"sec": stamp_ns // SECOND, "nanosec": stamp_ns % SECOND}
    return {"header": {"stamp": stamp, "frame_id": "base"}, "value": value}


def write_stamped(path: Path, messages: Messages) -> Path:
    ordered = sorted(enumerate(messages), key=lambda item: item[1][1])
    return record(
        path,
        (
            (topic, STAMPED, START_NS + log, stamped(value, stamp_ns))
            for value, (topic, log, stamp_ns) in ordered
        ),
    )
