"""This file splits batches so that each fits into one message, by arithmetic on Arrow's layout and without encoding."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

__all__ = ["encoded_bits", "framing_bytes", "row_spans"]

_BUFFERS = 3
"""Of one column at most: validity, offsets, values."""
_PER_BUFFER_BYTES = 64 + 16
"""Padding, and the buffer's entry in the message's head."""
_PER_COLUMN_BYTES = 16
_HEAD_BYTES = 1024
_OFFSETS: dict[pa.DataType, type[np.integer[Any]]] = {
    pa.string(): np.int32,
    pa.binary(): np.int32,
    pa.large_string(): np.int64,
    pa.large_binary(): np.int64,
}


def framing_bytes(schema: pa.Schema) -> int:
    """Return the most that one message of these columns is larger than its rows."""
    columns = sum(_columns(field.type) for field in schema)
    return _HEAD_BYTES + columns * (_BUFFERS * _PER_BUFFER_BYTES + _PER_COLUMN_BYTES)


def row_spans(batch: pa.RecordBatch, *, most_bytes: int) -> list[tuple[int, int, int]]:
    """Return first row, row count and size in bytes of pieces of at most `most_bytes`, as few as there can be.

    A row that is larger is a piece of its own.
    """
    if batch.nbytes <= most_bytes:
        return [(0, batch.num_rows, batch.nbytes)] if batch.num_rows else []
    ends = _batch_bits(batch)
    spans: list[tuple[int, int, int]] = []
    row = 0
    while row < batch.num_rows:
        fits = int(np.searchsorted(ends, ends[row] + most_bytes * 8, side="right")) - 1
        stop = max(fits, row + 1)
        spans.append((row, stop - row, -(-int(ends[stop] - ends[row]) // 8)))
        row = stop
    return spans


def encoded_bits(array: pa.Array[Any]) -> NDArray[np.int64]:
    """Return how many bits the rows before each one take when encoded, shape (n + 1,)."""
    rows = np.arange(len(array) + 1, dtype=np.int64)
    return rows * _validity_bits(array) + _value_bits(array, rows)


def _batch_bits(batch: pa.RecordBatch) -> NDArray[np.int64]:
    total = np.zeros(batch.num_rows + 1, dtype=np.int64)
    for column in batch.columns:
        total += encoded_bits(column)
    return total


def _value_bits(array: Any, rows: NDArray[np.int64]) -> NDArray[np.int64]:  # noqa: ANN401 - every array class
    kind = array.type
    fixed = _fixed_bits(kind)
    if fixed is not None:
        return rows * fixed
    if pa.types.is_struct(kind):
        return sum((encoded_bits(array.field(i)) for i in range(kind.num_fields)), np.zeros_like(rows))
    if pa.types.is_fixed_size_list(kind):
        return _within(array.values, (rows + array.offset) * kind.list_size)
    if isinstance(array, pa.ListArray | pa.LargeListArray):
        offsets = array.offsets.to_numpy()
        return _within(array.values, offsets) + rows * offsets.itemsize * 8
    if kind in _OFFSETS:
        offsets = _offsets(array, _OFFSETS[kind])
        return (offsets - offsets[0]) * 8 + rows * np.dtype(_OFFSETS[kind]).itemsize * 8
    # Any other type of varying width: its bytes, shared out evenly.
    return rows * (-(-array.nbytes * 8 // max(len(array), 1)))


def _within(values: Any, offsets: NDArray[np.integer[Any]]) -> NDArray[np.int64]:  # noqa: ANN401 - every array class
    """Return what of the values lies before each offset, counted from the first."""
    each = _fixed_bits(values.type)
    if each is not None:  # no array as long as the values, which may be millions
        return (offsets.astype(np.int64) - int(offsets[0])) * (each + _validity_bits(values))
    before = encoded_bits(values)[offsets]
    return before - before[0]


def _validity_bits(array: pa.Array[Any]) -> int:
    return 1 if array.null_count else 0


def _fixed_bits(kind: pa.DataType) -> int | None:
    """Return how many bits every value takes beside its own validity, None where they differ."""
    if isinstance(kind, pa.StructType | pa.FixedSizeListType):
        inner = [_fixed_bits(kind.field(i).type) for i in range(kind.num_fields)]
        each = [1 + bits for bits in inner if bits is not None]
        times = kind.list_size if isinstance(kind, pa.FixedSizeListType) else 1
        return sum(each) * times if len(each) == len(inner) else None
    try:
        return kind.bit_width
    except ValueError:
        return None


def _offsets(array: Any, kind: type[np.integer[Any]]) -> NDArray[np.int64]:  # noqa: ANN401 - string and binary arrays
    buffer = array.buffers()[1]
    if buffer is None or not len(array):
        return np.zeros(len(array) + 1, dtype=np.int64)
    offsets = np.frombuffer(buffer, dtype=kind)[array.offset : array.offset + len(array) + 1]
    return offsets.astype(np.int64)


def _columns(kind: pa.DataType) -> int:
    return 1 + sum(_columns(kind.field(i).type) for i in range(kind.num_fields))
