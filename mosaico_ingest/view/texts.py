"""Texts for people: values of rows, and excerpts of log and text topics."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.types as pt
from msgspec import Struct

from mosaico_ingest.destinations.store.model import TopicInfo
from mosaico_ingest.destinations.store.store import Window, scan
from mosaico_ingest.display import bytes_text, count_text, counted, time_text
from mosaico_ingest.images import image_file_type
from mosaico_ingest.view.rows import column_schema

if TYPE_CHECKING:
    from mosaico_ingest.view.columns import ColumnStatistics

BOUND_WIDTH = 20
"""Characters of the smallest and the largest value of a column."""
_SECOND = 1_000_000_000
_FIRST_INSTANT_NS = 10**17
"""Times before March 1973 are durations, or times of a simulation, which starts at 0."""
_PARTS = (("seconds", "nanoseconds"), ("sec", "nanosec"), ("secs", "nsecs"))
_VIDEO_START = b"\0\0\0\1"
MAX_ROWS = 200_000
"""Rows of a topic that are searched."""
MAX_TEXT = 500
"""Characters of a line."""
LEVELS_ROS1 = {1: "debug", 2: "info", 4: "warning", 8: "error", 16: "fatal"}
LEVELS_ROS2 = {10: "debug", 20: "info", 30: "warning", 40: "error", 50: "fatal"}
LEVELS_DIAGNOSTICS = {0: "ok", 1: "warning", 2: "error", 3: "stale"}
SEVERE = {"warning", "error", "fatal", "stale"}


def value_text(value: object, width: int) -> str:
    """Return a value as text of about `width` characters; the text states how much is omitted."""
    if isinstance(value, list | tuple):
        texts = [value_text(item, width) for item in value[:width]]
        return _members_text(texts, "[]", "value", width, len(value))
    if isinstance(value, dict):
        instant_ns = time_parts_ns(value)
        if instant_ns is not None:
            return instant_text(instant_ns)
        members = [f"{key}: {value_text(item, width)}" for key, item in value.items()]
        return _members_text(members, "{}", "member", width, len(members))
    if isinstance(value, str):
        return value if len(value) <= width else f"{value[:width]}… ({len(value)} characters)"
    return _plain_text(value)


def _plain_text(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, bytes):
        return _bytes_text(value)
    if isinstance(value, float):
        return _float_text(value)
    return str(value).lower() if isinstance(value, bool) else str(value)


def scalar_text(scalar: pa.Scalar[Any], width: int) -> str:
    """Return `value_text` of an Arrow scalar, without converting the items of a long list that are not shown."""
    if isinstance(scalar, pa.ListScalar | pa.LargeListScalar | pa.FixedSizeListScalar):
        items: pa.Array[Any] | None = scalar.values
        if items is None:
            return "-"
        values = [
            _without_nulls(item) if isinstance(item, dict) else item for item in items[:width].to_pylist()
        ]
        texts = [value_text(item, width) for item in values]
        return _members_text(texts, "[]", "value", width, len(items))
    value: Any = scalar.as_py()
    return value_text(_without_nulls(value) if isinstance(value, dict) else value, width)


def _without_nulls(struct: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return a struct without null members and with lists after other members, or None if all are null."""
    members = {
        key: _without_nulls(member) if isinstance(member, dict) else member for key, member in struct.items()
    }
    present = {key: member for key, member in members.items() if member is not None}
    return dict(sorted(present.items(), key=lambda item: isinstance(item[1], list))) or None


def instant_text(time_ns: int) -> str:
    """Return an instant in UTC with as many decimals as it needs, or a duration such as `12.5 s`."""
    if abs(time_ns) < _FIRST_INSTANT_NS:
        seconds, rest = divmod(abs(time_ns), _SECOND)
        fraction = f".{rest:09}".rstrip("0") if rest else ""
        return f"{'-' if time_ns < 0 else ''}{seconds}{fraction} s"
    try:
        instant = datetime.fromtimestamp(time_ns // _SECOND, tz=timezone.utc)
    except (OverflowError, ValueError, OSError):
        return time_text(time_ns)
    digits = f"{time_ns % _SECOND:09}"
    while len(digits) > 3 and digits.endswith("000"):  # noqa: PLR2004 - at least milliseconds
        digits = digits[:-3]
    return f"{instant:%Y-%m-%d %H:%M:%S}.{digits}"


def time_parts_ns(value: Mapping[str, Any]) -> int | None:
    """Return the ns of a time in seconds and nanoseconds, or None for any other struct and for null parts."""
    for seconds, rest in _PARTS:
        if set(value) == {seconds, rest} and isinstance(value[seconds], int) and isinstance(value[rest], int):
            return value[seconds] * _SECOND + value[rest]
    return None


class ColumnTexts(Struct, frozen=True):
    """The statistics of a column as text, in the order of a table."""

    path: str
    type: str
    unit: str
    nulls: str
    minimum: str
    maximum: str
    mean: str
    distinct: str


def column_texts(column: ColumnStatistics) -> ColumnTexts:
    """Return the statistics of a column as text: `-` without a value, `?` if it is unknown."""
    is_size = "binary" in column.type
    low, high = (
        "-" if bound is None
        else instant_text(bound) if column.is_time
        else bytes_text(bound) if is_size
        else value_text(bound, BOUND_WIDTH)
        for bound in (column.minimum, column.maximum)
    )  # fmt: skip
    mean = "-" if column.mean is None else bytes_text(column.mean) if is_size else f"{column.mean:.6g}"
    nulls = "?" if column.nulls is None else count_text(column.nulls)
    nulls += f" +{count_text(column.nan)} NaN" if column.nan else ""
    if column.distinct is not None:
        distinct = count_text(column.distinct)
    else:
        distinct = "?" if column.rows is None else "> 10,000" if column.rows else "-"
    kind = "time" if column.is_time else _type_text(column)
    return ColumnTexts(column.path, kind, column.unit, nulls, low, high, mean, distinct)


def _type_text(column: ColumnStatistics) -> str:
    """Return the type; of lists with the lengths, as in `double[9]` or `float[0..64]`."""
    if column.lengths is None:
        return column.type
    shortest, longest = column.lengths
    item = column.type.partition("item: ")[2].partition(">")[0].removesuffix(" not null") or column.type
    return f"{item}[{shortest if shortest == longest else f'{shortest}..{longest}'}]"


def json_value(value: object) -> Any:  # noqa: ANN401 - any JSON value
    """Return a value that JSON can represent: bytes as `<12 bytes>`, NaN and infinities as text."""
    if isinstance(value, bytes):
        return _bytes_text(value)
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    if isinstance(value, Mapping):
        return {str(key): json_value(member) for key, member in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [json_value(member) for member in value]
    return value if isinstance(value, str | int | float | bool | None) else str(value)


def flat_text(value: object) -> str:
    """Return a value for a cell of a CSV file: empty for null, lists and structs as JSON."""
    if value is None:
        return ""
    if isinstance(value, Mapping) or (isinstance(value, Sequence) and not isinstance(value, str | bytes)):
        return json.dumps(json_value(value), ensure_ascii=False)
    if isinstance(value, bool):
        return str(value).lower()
    return _bytes_text(value) if isinstance(value, bytes) else str(value)


def _bytes_text(value: bytes) -> str:
    kind = image_file_type(value) or ("video" if value.startswith(_VIDEO_START) else "")
    return f"<{counted(len(value), 'byte')}{f', {kind}' if kind else ''}>"


def _float_text(value: float) -> str:
    """Return nine digits, or fewer if they determine a float32, as most sensors measure."""
    if not math.isfinite(value):
        return "NaN" if math.isnan(value) else str(value)
    with np.errstate(over="ignore"):
        single = np.float32(value)
    if float(single) == value:
        return str(single)
    text = f"{value:.9g}"
    return text if any(mark in text for mark in ".e") else f"{text}.0"


def _members_text(members: Sequence[str], brackets: str, noun: str, width: int, count: int) -> str:
    """Return the members that fit, in brackets, and their total `count`."""
    text = ", ".join(members)
    if len(text) <= width and len(members) == count:
        return f"{brackets[0]}{text}{brackets[1]}"
    first, length = list[str](), 0
    for member in members:
        length += len(member) + len(", ")
        if length > width:
            break
        first.append(member)
    members_text = ", ".join((*first, "…")) if first or not members else f"{members[0][:width]}…"
    return f"{brackets[0]}{members_text}{brackets[1]} ({counted(count, noun)})"


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
    schema = column_schema(topic, [name for name in fields if name in topic.schema.names])
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
