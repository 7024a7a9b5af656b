"""Batches as arrow-rs sends them: zero-length nested lists have an offsets buffer of 0 bytes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa

EMPTY = pa.py_buffer(b"")


def hollow_batch(schema: pa.Schema, rows: int) -> pa.RecordBatch:
    """Return `rows` rows in which every list is empty, and every child of a list has 0-byte buffers."""
    columns: list[Any] = [pa.array(range(rows), pa.int64())]
    columns += [hollow_array(field.type, rows, nullable=field.nullable) for field in list(schema)[1:]]
    return pa.RecordBatch.from_arrays(columns, schema=schema)


def hollow_array(kind: Any, length: int, *, nullable: bool = False) -> Any:
    """Return an array without a buffer that has a byte more than `length` values need; with 0, no byte at all."""
    if isinstance(kind, pa.StructType):
        children = [hollow_array(child.type, length, nullable=child.nullable) for child in kind]
        return pa.Array.from_buffers(kind, length, [None], children=children)
    if isinstance(kind, pa.FixedSizeListType):
        values = hollow_array(kind.value_type, length * kind.list_size)
        return pa.Array.from_buffers(kind, length, [None], children=[values])
    if isinstance(kind, pa.ListType | pa.LargeListType | pa.MapType):
        width = 8 if isinstance(kind, pa.LargeListType) else 4
        offsets = pa.py_buffer(bytes((length + 1) * width)) if length else EMPTY
        if isinstance(kind, pa.MapType):
            values = hollow_array(pa.struct([kind.key_field, kind.item_field]), 0)
        else:
            values = hollow_array(kind.value_type, 0)
        return pa.Array.from_buffers(kind, length, [None, offsets], children=[values])
    if isinstance(kind, pa.DictionaryType):
        return pa.array([None] * length, kind)
    if length or kind == pa.null():
        return pa.array([None] * length, kind) if nullable else plain_array(kind, length)
    return pa.Array.from_buffers(kind, 0, [None, EMPTY] if fixed(kind) else [None, EMPTY, EMPTY])


def plain_array(kind: Any, length: int) -> Any:
    value: Any = "" if pa.types.is_string(kind) or pa.types.is_large_string(kind) else 0
    if pa.types.is_binary(kind) or pa.types.is_large_binary(kind):
        value = b""
    return pa.array([value] * length).cast(kind)


def fixed(kind: Any) -> bool:
    try:
        return bool(kind.bit_width)
    except ValueError:
        return False


def malformed_batch() -> pa.RecordBatch:
    """Return two rows with a text whose offset is out of range, as no writer but a hostile one sends it."""
    offsets = np.array([0, 1, 3], np.int32)
    text: Any = pa.Array.from_buffers(pa.string(), 2, [None, pa.py_buffer(offsets), pa.py_buffer(b"abc")])
    schema = pa.schema([pa.field("timestamp_ns", pa.int64(), nullable=False), pa.field("a", pa.string())])
    batch = pa.RecordBatch.from_arrays([pa.array([1, 2]), text], schema=schema)
    offsets[1] = 1 << 28  # pyarrow checks the array when it is created only
    return batch
