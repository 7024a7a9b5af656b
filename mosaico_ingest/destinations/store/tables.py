"""Rows of a topic as Arrow tables: a time range, selected columns, flattened structs."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta, timezone
from typing import TYPE_CHECKING, Any, TypeAlias

import pyarrow as pa
import pyarrow.compute as pc

from mosaico_ingest.destinations.store.store import Window, scan
from mosaico_ingest.errors import SinkError
from mosaico_ingest.findings import suggest_names
from mosaico_ingest.job.units import parse_time

if TYPE_CHECKING:
    from mosaico_ingest.destinations.store.model import TopicInfo

Moment: TypeAlias = "int | str | datetime"
"""A time: ns since the epoch, a text such as `2026-03-01T12:00:00Z`, `+10s` or `-5s`, or a `datetime` (UTC by default)."""

_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)


def bound_ns(topic: TopicInfo, moment: Moment | None) -> int | None:
    """Return a time in ns since the epoch; `+10s` counts from the first row of the topic, `-5s` from the last.

    Raises:
        SinkError: The text is not a time.
    """
    if moment is None or isinstance(moment, int):
        return moment
    if isinstance(moment, datetime):
        aware = moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)
        return (aware - _EPOCH) // timedelta(microseconds=1) * 1000
    try:
        bound = parse_time(moment)
    except ValueError as error:
        raise SinkError(str(error), where=f"{topic.sequence}{topic.name}") from error
    if not bound.relative:
        return bound.ns
    origin = topic.end_ns if moment.startswith("-") else topic.start_ns
    return (origin or 0) + bound.ns


def topic_reader(
    topic: TopicInfo,
    *,
    start: Moment | None = None,
    end: Moment | None = None,
    columns: Sequence[str] | None = None,
) -> pa.RecordBatchReader:
    """Return a reader of the rows ordered by time; `columns` are names of top-level columns."""
    schema = topic.schema
    if columns is not None:
        _check(topic, columns, schema.names)
        schema = pa.schema([schema.field(name) for name in dict.fromkeys([schema.names[0], *columns])])
    window = Window(bound_ns(topic, start), bound_ns(topic, end))
    return pa.RecordBatchReader.from_batches(schema, scan(topic.segments, schema, window))


def read_table(
    topic: TopicInfo,
    *,
    start: Moment | None = None,
    end: Moment | None = None,
    columns: Sequence[str] | None = None,
    flatten: bool = False,
) -> pa.Table:
    """Return the rows from `start` (inclusive) to `end` (exclusive), ordered by time.

    `columns` selects columns (`pose`) and members of structs (`pose.position.x`); `timestamp_ns` is always the first
    column. `flatten` replaces each struct with one column per member, such as `pose.position.x`.

    Raises:
        SinkError: A column does not exist; the hint names existing ones.
    """
    if columns is None:
        table = topic_reader(topic, start=start, end=end).read_all()
    else:
        _check(topic, columns, _paths(topic.schema, ""))
        names = list(dict.fromkeys(path.partition(".")[0] for path in columns))
        table = _selected(topic_reader(topic, start=start, end=end, columns=names).read_all(), columns)
    while flatten and any(pa.types.is_struct(field.type) for field in table.schema):
        table = table.flatten()
    return table


def _check(topic: TopicInfo, columns: Sequence[str], known: Sequence[str]) -> None:
    for name in columns:
        if name not in known:
            raise SinkError(
                f"there is no column {name!r}",
                where=f"{topic.sequence}{topic.name}",
                hint=suggest_names(known, [name]),
            )


def _selected(table: pa.Table, columns: Sequence[str]) -> pa.Table:
    paths = list(dict.fromkeys([table.schema.names[0], *columns]))
    member: Any = pc.struct_field  # its stubs accept no list of names
    values = [
        member(table.column(path.partition(".")[0]), path.split(".")[1:])
        if "." in path
        else table.column(path)
        for path in paths
    ]
    return pa.table(values, names=paths)


def _paths(fields: Any, prefix: str) -> list[str]:  # noqa: ANN401 - a schema or a struct type
    paths: list[str] = []
    for field in fields:
        paths.append(f"{prefix}{field.name}")
        if pa.types.is_struct(field.type):
            paths += _paths(field.type, f"{prefix}{field.name}.")
    return paths
