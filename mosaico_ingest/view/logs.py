"""Excerpts of log and text topics: the most severe lines, in order of time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import pyarrow as pa
import pyarrow.types as pt
from msgspec import Struct

from mosaico_ingest.destinations.store.model import TopicInfo
from mosaico_ingest.destinations.store.store import Window, scan

MAX_ROWS = 200_000
"""Rows of a topic that are searched."""
MAX_TEXT = 500
"""Characters of a line."""
LEVELS_ROS1 = {1: "debug", 2: "info", 4: "warning", 8: "error", 16: "fatal"}
LEVELS_ROS2 = {10: "debug", 20: "info", 30: "warning", 40: "error", 50: "fatal"}
LEVELS_DIAGNOSTICS = {0: "ok", 1: "warning", 2: "error", 3: "stale"}
SEVERE = {"warning", "error", "fatal", "stale"}


class LogLine(Struct, frozen=True):
    """One line of a log."""

    time_ns: int
    level: str
    """`debug`, `info`, `warning`, `error` or `fatal`; empty if the topic has no levels."""
    source: str
    """The node or component; empty if the topic has none."""
    text: str


class LogExcerpt(Struct, frozen=True):
    """The lines of one topic that matter most."""

    topic: str
    lines: tuple[LogLine, ...]
    counts: dict[str, int]
    """Number of lines by level."""
    is_severe: bool
    """Whether `lines` are warnings and errors; otherwise they are the first lines."""


def has_log(topic: TopicInfo) -> bool:
    """Return whether the rows of a topic are lines of a log, diagnostics or texts."""
    return _kind(topic.schema) is not None


def read_excerpt(topic: TopicInfo, count: int = 50) -> LogExcerpt | None:
    """Return the first `count` warnings and errors of a topic, or its first lines if it has none; None without lines."""
    first: list[LogLine] = []
    severe: list[LogLine] = []
    counts: Counter[str] = Counter()
    for line in log_lines(topic):
        counts[line.level] += 1
        if len(first) < count:
            first.append(line)
        if line.level in SEVERE and len(severe) < count:
            severe.append(line)
    if not first:
        return None
    return LogExcerpt(topic.name, tuple(severe or first), dict(counts), bool(severe))


def _kind(schema: pa.Schema) -> str | None:
    names = set(schema.names)
    if {"level", "msg"} <= names and _is_text(schema.field("msg").type):
        return "log"
    if "status" in names and pt.is_list(schema.field("status").type):
        item: Any = schema.field("status").type
        members = {member.name for member in item.value_type} if pt.is_struct(item.value_type) else set[str]()
        return "diagnostics" if {"level", "message", "name"} <= members else None
    if names == {"timestamp_ns", "data"} and _is_text(schema.field("data").type):
        return "text"
    return None


def log_lines(topic: TopicInfo) -> Iterator[LogLine]:
    """Yield the lines of the first `MAX_ROWS` rows in order of time; none if the topic has no lines."""
    kind = _kind(topic.schema)
    fields = {"log": ["level", "name", "msg"], "diagnostics": ["status"], "text": ["data"]}.get(
        kind or "", []
    )
    names = [topic.schema.names[0], *(name for name in fields if name in topic.schema.names)]
    schema = pa.schema([topic.schema.field(name) for name in names])
    rows = 0
    for batch in scan(topic.segments, schema, Window()) if kind else ():
        for row in batch.slice(0, MAX_ROWS - rows).to_pylist():
            yield from _row_lines(kind or "", row)
        rows += batch.num_rows
        if rows >= MAX_ROWS:
            return


def _row_lines(kind: str, row: dict[str, Any]) -> Iterator[LogLine]:
    time_ns = int(row["timestamp_ns"])
    if kind == "text":
        yield LogLine(time_ns, "", "", str(row["data"])[:MAX_TEXT])
    elif kind == "log":
        code = _number(row["level"])
        level = LEVELS_ROS2.get(code) or LEVELS_ROS1.get(code) or str(code)
        yield LogLine(time_ns, level, str(row.get("name") or "")[:MAX_TEXT], str(row["msg"])[:MAX_TEXT])
    else:
        for status in row["status"] or ():
            level = LEVELS_DIAGNOSTICS.get(_number(status["level"]), "")
            yield LogLine(time_ns, level, str(status["name"])[:MAX_TEXT], str(status["message"])[:MAX_TEXT])


def _number(value: object) -> int:
    """Return a level; ROS 2 stores that of diagnostics as one byte."""
    if isinstance(value, bytes):
        return int.from_bytes(value[:1], "little")
    return value if isinstance(value, int) else -1


def _is_text(kind: pa.DataType) -> bool:
    return pt.is_string(kind) or pt.is_large_string(kind)
