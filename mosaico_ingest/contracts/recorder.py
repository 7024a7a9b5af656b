"""Events that recorders write into a recording: pauses, and topics that they stopped and resumed recording.

The known events are those of rosbag2_dynamic_recorder: `PauseEvent` with an `action` (0 paused, 1 resumed), and
`SubscriptionChangeEvent` with a `topic` and an `action` (0 subscribed, 1 unsubscribed). Types of other packages with the
same names and fields count, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.rosbag.blocks import LATEST_NS, Connection, Encoding
from mosaico_ingest.rosbag.recording import Recording

_PAUSE, _SUBSCRIPTION = "PauseEvent", "SubscriptionChangeEvent"
_FIELDS = {_PAUSE: {"action"}, _SUBSCRIPTION: {"action", "topic"}}
_STARTS = {_PAUSE: 0, _SUBSCRIPTION: 1}
"""The action that starts a window without messages; the other action ends it."""

Windows = NDArray[np.int64]
"""Start and end of each window in nanoseconds since the epoch, sorted and disjoint, shape (n, 2)."""
NO_WINDOWS: Windows = np.zeros((0, 2), np.int64)


class RecorderEvents(Struct, frozen=True):
    """The windows in which the recorder did not record."""

    paused: Windows = NO_WINDOWS
    by_topic: Mapping[str, Windows] = {}

    def windows_of(self, topic: str) -> Windows:
        """Return the windows in which a topic was not recorded."""
        own = self.by_topic.get(topic)
        return self.paused if own is None else _merged([*self.paused.tolist(), *own.tolist()])


def event_connections(connections: Iterable[Connection]) -> tuple[Connection, ...]:
    """Return the connections whose messages are events of the recorder."""
    return tuple(
        connection
        for connection in connections
        if connection.definition is not None
        and connection.encoding is not Encoding.OTHER
        and connection.count != 0
        and _FIELDS.get(_kind(connection), {""})
        <= {field.name for field in connection.definition.message.fields}
    )


def read_events(recording: Recording) -> RecorderEvents:
    """Read the events of the recorder; events that cannot be decoded are ignored."""
    connections = {connection.id: connection for connection in event_connections(recording.connections)}
    if not connections:
        return RecorderEvents()
    from mosaico_ingest.decode.decoder import decoder_for  # noqa: PLC0415 - few recordings have events

    decoders = {key: decoder_for(connection) for key, connection in connections.items()}
    events: list[tuple[int, str, str, bool]] = []
    for block in recording.message_blocks(tuple(connections)):
        decoded = decoders[block.connection].decode(block)
        kind = _kind(connections[block.connection])
        rows: Any = decoded.rows  # the stubs lack to_pylist of struct arrays
        for row, time in zip(rows.to_pylist(), block.log_times[decoded.index].tolist(), strict=True):
            topic = str(row["topic"]) if kind == _SUBSCRIPTION else ""
            events.append((time, kind, topic, int(row["action"]) == _STARTS[kind]))
    events.sort(key=lambda event: event[0])
    paused = _windows((time, starts) for time, kind, _, starts in events if kind == _PAUSE)
    topics = dict.fromkeys(topic for _, kind, topic, _ in events if kind == _SUBSCRIPTION)
    return RecorderEvents(
        paused,
        {
            name: _windows((time, starts) for time, _, topic, starts in events if topic == name)
            for name in topics
        },
    )


def uncovered_ns(starts: NDArray[np.int64], ends: NDArray[np.int64], windows: Windows) -> NDArray[np.int64]:
    """Return the longest part of each interval that no window covers, in nanoseconds, shape (n,)."""
    return np.array(
        [
            _longest_rest(start, end, windows)
            for start, end in zip(starts.tolist(), ends.tolist(), strict=True)
        ],
        np.int64,
    )


def covered_ns(start: int, end: int, windows: Windows) -> int:
    """Return the time of an interval that windows cover, in nanoseconds."""
    overlaps = np.minimum(windows[:, 1], end) - np.maximum(windows[:, 0], start)
    return int(overlaps[overlaps > 0].sum())


def _longest_rest(start: int, end: int, windows: Windows) -> int:
    inside = windows[(windows[:, 1] > start) & (windows[:, 0] < end)]
    rest, position = 0, start
    for window_start, window_end in inside.tolist():
        rest = max(rest, window_start - position)
        position = max(position, window_end)
    return max(rest, end - position)


def _kind(connection: Connection) -> str:
    return connection.msgtype.rpartition("/")[2]


def _windows(events: Iterable[tuple[int, bool]]) -> Windows:
    """Return the windows between events that start and end one; a window that never ends lasts forever."""
    windows: list[list[int]] = []
    start: int | None = None
    for time, starts in events:
        if starts and start is None:
            start = time
        elif not starts and start is not None:
            windows.append([start, time])
            start = None
    if start is not None:
        windows.append([start, LATEST_NS])
    return _merged(windows)


def _merged(windows: list[list[int]]) -> Windows:
    merged: list[list[int]] = []
    for start, end in sorted(windows):
        if merged and start <= merged[-1][1]:
            merged[-1][1] = max(merged[-1][1], end)
        else:
            merged.append([start, end])
    return np.array(merged, np.int64).reshape(-1, 2)
