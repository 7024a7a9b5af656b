"""This file makes required fields of absent structs presentable: writers look for nulls in the child, not at the parent."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.types as pt

__all__ = ["fill_required"]

_arrays: Any = pa
"""The stubs do not know `type` beside `mask`."""


def fill_required(rows: pa.StructArray) -> pa.StructArray:
    """Return the same rows, where a required field that is null because its struct is null holds zero instead.

    No value that can be seen changes. Parquet's writer refuses `struct<a: int32 not null>` with a null in `a`
    although the struct itself is null there.
    """
    return cast("pa.StructArray", _filled(rows))  # a struct stays one


def _filled(array: Any) -> Any:  # noqa: ANN401 - any Arrow array; the stubs have no common base with children
    if not _has_required(array.type):
        return array
    if pt.is_struct(array.type):
        return _filled_struct(array)
    return _filled_fixed(array) if pt.is_fixed_size_list(array.type) else _filled_list(array)


def _filled_fixed(array: Any) -> Any:  # noqa: ANN401 - as above
    size = array.type.list_size
    values = array.values.slice(array.offset * size, len(array) * size)
    filled = _filled(values)
    if filled is values:
        return array
    mask = pc.is_null(array) if array.null_count else None
    return _arrays.FixedSizeListArray.from_arrays(filled, type=array.type, mask=mask)


def _filled_list(array: Any) -> Any:  # noqa: ANN401 - as above
    values = array.values
    filled = _filled(values)
    if filled is values:
        return array
    # A null offset is a null list; `mask` does not go with a slice.
    absent = np.append(array.is_null().to_numpy(zero_copy_only=False), False)
    offsets = pa.array(array.offsets.to_numpy(), pa.int32(), mask=absent)
    return pa.ListArray.from_arrays(offsets, filled, type=array.type)


def _filled_struct(array: Any) -> Any:  # noqa: ANN401 - as above
    children = [array.field(position) for position in range(array.type.num_fields)]
    filled = [
        _without_nulls(_filled(child)) if not field.nullable and child.null_count else _filled(child)
        for child, field in zip(children, array.type, strict=True)
    ]
    if all(new is old for new, old in zip(filled, children, strict=True)):
        return array
    mask = pc.is_null(array) if array.null_count else None
    return pa.StructArray.from_arrays(filled, fields=list(array.type), mask=mask)


def _without_nulls(array: Any) -> Any:  # noqa: ANN401 - as above
    """Return the values with whatever lies under a null."""
    if pt.is_struct(array.type):
        children = [array.field(position) for position in range(array.type.num_fields)]
        return pa.StructArray.from_arrays(children, fields=list(array.type))
    if pt.is_list(array.type):
        return pc.if_else(pc.is_null(array), pa.scalar([], array.type), array)
    return pc.fill_null(array, _zero(array.type))


def _zero(kind: pa.DataType) -> pa.Scalar[Any]:
    if pt.is_string(kind) or pt.is_large_string(kind):
        return pa.scalar("", kind)
    if pt.is_binary(kind) or pt.is_large_binary(kind):
        return pa.scalar(b"", kind)
    return pa.scalar(False if pt.is_boolean(kind) else 0, kind)


def _has_required(kind: pa.DataType) -> bool:
    """Whether there is a required field somewhere inside."""
    if pt.is_struct(kind):
        return any(not field.nullable or _has_required(field.type) for field in kind)
    if pt.is_list(kind) or pt.is_fixed_size_list(kind):
        return _has_required(kind.value_type)
    return False
