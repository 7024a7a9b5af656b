"""Columns of a topic as people name them: paths through structs, with times in one column."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.types as pt
from msgspec import Struct

from mosaico_ingest.adapters.mapping.columns import time_ns

_compute: Any = pc
"""`pyarrow.compute`, whose stubs do not accept arrays of any type."""
_TIMES = ({"seconds", "nanoseconds"}, {"sec", "nanosec"}, {"secs", "nsecs"})
"""Names of the parts of a time or duration in ontology types and in the messages of ROS 2 and ROS 1."""
_TIMESTAMP = "timestamp_ns"


class Column(Struct, frozen=True):
    """A column without members: a value, a list, or a time in two parts."""

    path: str
    """The path, such as `acceleration.x`; `transforms[].translation.x` for members of the structs in a list."""
    steps: tuple[str, ...]
    """The names of the fields on the path."""
    type: pa.DataType
    """The type of the values; int64 for times."""
    is_time: bool = False
    """Whether the values are times or durations, in ns."""
    nullable: bool = True

    @property
    def name(self) -> str:
        """The top-level column."""
        return self.steps[0]

    def values(self, batch: pa.RecordBatch) -> pa.Array[Any]:
        """Return the values in a batch, one per row; null if a struct on the path is null.

        Members of the structs in a list have one value per struct instead.
        """
        values: pa.Array[Any] = batch.column(self.name)
        for step in self.steps[1:]:
            values = _member(values, step)
        return time_ns(values) if self.is_time and pt.is_struct(values.type) else values


def topic_columns(schema: pa.Schema) -> tuple[Column, ...]:
    """Return the columns of a topic in the order of the schema."""
    return tuple(column for field in schema for column in _walk(field, (), "", nullable=False))


def struct_paths(schema: pa.Schema) -> list[str]:
    """Return the paths of all columns and of the structs that contain them, such as `pose` and `pose.position.x`."""
    return [path for field in schema for path in _struct_paths(field, "")]


def path_values(table: pa.Table, path: str) -> pa.Array[Any]:
    """Return the values of a path such as `pose.position`, one per row."""
    name, *members = path.split(".")
    column = table.column(name)
    values: Any = _compute.struct_field(column, members) if members else column
    return values.combine_chunks() if isinstance(values, pa.ChunkedArray) else values


def flat_columns(path: str, values: pa.Array[Any]) -> Iterator[tuple[str, pa.Array[Any]]]:
    """Yield the path and the values of each column in a struct; times and lists remain as they are."""
    kind = values.type
    if not pt.is_struct(kind) or _is_time(kind):
        yield path, values
        return
    for member in kind:
        yield from flat_columns(f"{path}.{member.name}", _compute.struct_field(values, member.name))


def time_values(values: pa.Array[Any]) -> pa.Array[Any]:
    """Return times in two parts in ns, and other values unchanged."""
    return time_ns(values) if _is_time(values.type) else values


def is_number(kind: pa.DataType) -> bool:
    """Return whether values of this type are numbers."""
    return pt.is_integer(kind) or pt.is_floating(kind) or pt.is_decimal(kind)


def is_binary(kind: pa.DataType) -> bool:
    """Return whether values of this type are bytes."""
    return (
        pt.is_binary(kind)
        or pt.is_large_binary(kind)
        or pt.is_fixed_size_binary(kind)
        or pt.is_binary_view(kind)
    )


def is_list(kind: pa.DataType) -> bool:
    """Return whether values of this type are lists."""
    return pt.is_list(kind) or pt.is_large_list(kind) or pt.is_fixed_size_list(kind)


def _walk(field: pa.Field[Any], steps: tuple[str, ...], prefix: str, *, nullable: bool) -> Iterator[Column]:
    steps, path = (*steps, field.name), f"{prefix}{field.name}"
    kind: pa.DataType = field.type
    nullable = nullable or field.nullable
    if _is_time(kind):
        yield Column(path, steps, pa.int64(), is_time=True, nullable=nullable)
    elif pt.is_struct(kind):
        for member in kind:
            yield from _walk(member, steps, f"{path}.", nullable=nullable)
    elif is_list(kind) and pt.is_struct(_item_type(kind)) and not _is_time(_item_type(kind)):
        for member in cast("pa.StructType", _item_type(kind)):
            yield from _walk(member, steps, f"{path}[].", nullable=nullable)
    else:
        is_timestamp = path == _TIMESTAMP or pt.is_timestamp(kind)
        yield Column(path, steps, kind, is_time=is_timestamp, nullable=nullable)


def _struct_paths(field: pa.Field[Any], prefix: str) -> Iterator[str]:
    path = f"{prefix}{field.name}"
    yield path
    if pt.is_struct(field.type):
        for member in field.type:
            yield from _struct_paths(member, f"{path}.")


def _item_type(kind: pa.DataType) -> pa.DataType:
    return cast("pa.ListType[Any]", kind).value_type


def _is_time(kind: pa.DataType) -> bool:
    if not pt.is_struct(kind):
        return False
    members = list(kind)
    return {member.name for member in members} in _TIMES and all(pt.is_integer(m.type) for m in members)


def _member(values: pa.Array[Any], name: str) -> pa.Array[Any]:
    while is_list(values.type):
        values = cast("pa.ListArray[Any]", values).flatten()
    return _compute.struct_field(values, name)
