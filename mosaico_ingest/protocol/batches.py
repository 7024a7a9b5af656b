"""Record batches from other processes: validation, and buffers that are safe to measure.

Writers such as arrow-rs omit the offsets of zero-length arrays. pyarrow accepts such arrays, but `nbytes`,
`get_total_buffer_size` and `offsets` read past the end of the missing buffer, which crashes the process.
"""

from __future__ import annotations

from typing import Any

import pyarrow as pa


def validated(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Return a received batch that is safe to process.

    Raises:
        pa.ArrowInvalid: The buffers are inconsistent, for example because offsets are out of range.
    """
    batch.validate(full=True)
    return with_offsets(batch)


def with_offsets(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Return the batch with complete offsets in every zero-length array; other arrays are not copied."""
    columns = [_with_offsets(column) for column in batch.columns]
    if all(new is old for new, old in zip(columns, batch.columns, strict=True)):
        return batch
    return pa.RecordBatch.from_arrays(columns, schema=batch.schema)


def has_nested_lists(schema: pa.Schema) -> bool:
    """Return whether a column has a list inside a list, so that its batches may lack offsets."""
    return any(_list_depth(field.type) > 1 for field in schema)


def _with_offsets(array: Any) -> Any:  # noqa: ANN401 - any array class
    kind = array.type
    if len(array) == 0:
        return pa.array([], kind) if kind.num_fields else array
    if isinstance(kind, pa.StructType):
        return _complete_struct(array)
    if isinstance(kind, pa.ListType | pa.LargeListType | pa.FixedSizeListType | pa.MapType):
        return _complete_list(array)
    return array


def _complete_struct(array: Any) -> Any:  # noqa: ANN401 - a struct array
    children = [array.field(i) for i in range(array.type.num_fields)]
    complete = [_with_offsets(child) for child in children]
    if all(new is old for new, old in zip(complete, children, strict=True)):
        return array
    # `field` has applied the offset of the struct to its children
    mask = array.is_null() if array.null_count else None
    return pa.StructArray.from_arrays(complete, fields=list(array.type), mask=mask)


def _complete_list(array: Any) -> Any:  # noqa: ANN401 - a list or map array
    values = array.values
    complete = _with_offsets(values)
    if complete is values:
        return array
    buffers = array.buffers()[: 1 if isinstance(array.type, pa.FixedSizeListType) else 2]
    return pa.Array.from_buffers(array.type, len(array), buffers, array.null_count, array.offset, [complete])


def _list_depth(kind: Any) -> int:  # noqa: ANN401 - any Arrow type
    """Return the maximum number of nested list types."""
    inner = max((_list_depth(kind.field(i).type) for i in range(kind.num_fields)), default=0)
    return inner + (not isinstance(kind, pa.StructType) and kind.num_fields > 0)
