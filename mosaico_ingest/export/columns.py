"""Arrow columns in a given type: servers drop nested `not null` constraints and send string and binary views."""

from __future__ import annotations

from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from mosaico_ingest.errors import SinkError
from mosaico_ingest.ontology.registry import PLAIN_TYPES

_arrow: Any = pa
"""pyarrow, whose stubs do not accept `type` together with `mask`."""


def comparable(kind: Any) -> Any:  # noqa: ANN401 - any Arrow type
    """Return a type without the properties that a server does not keep: nullability, and the layout of texts and lists."""
    if pa.types.is_struct(kind):
        return pa.struct([pa.field(field.name, comparable(field.type)) for field in kind])
    if pa.types.is_list(kind) or pa.types.is_large_list(kind):
        return pa.list_(comparable(kind.value_type))
    if pa.types.is_fixed_size_list(kind):
        return pa.list_(comparable(kind.value_type), kind.list_size)
    return PLAIN_TYPES.get(kind, kind)


def as_type(array: Any, kind: Any, name: str = "") -> Any:  # noqa: ANN401 - any array and type
    """Return a column in a type that is equal up to `comparable`; `name` is used in errors.

    Raises:
        SinkError: The types differ, or a value is null where the type requires one.
    """
    if array.type == kind:
        return array
    mask = pc.is_null(array) if array.null_count else None
    if pa.types.is_struct(kind) and pa.types.is_struct(array.type):
        children = [
            as_type(array.field(array.type.get_field_index(field.name)), field.type, f"{name}.{field.name}")
            for field in kind
        ]
        return _arrow.StructArray.from_arrays(children, fields=list(kind), mask=mask)
    if pa.types.is_fixed_size_list(kind) and pa.types.is_fixed_size_list(array.type):
        values = array.values.slice(array.offset * kind.list_size, len(array) * kind.list_size)
        elements = as_type(values, kind.value_type, f"{name}[]")
        return _arrow.FixedSizeListArray.from_arrays(elements, type=kind, mask=mask)
    if pa.types.is_list(kind) or pa.types.is_large_list(kind):
        elements = as_type(array.values, kind.value_type, f"{name}[]")
        large = pa.types.is_large_list(kind)
        offsets = array.offsets.cast(pa.int64() if large else pa.int32())
        lists = _arrow.LargeListArray if large else _arrow.ListArray
        return lists.from_arrays(offsets, elements, type=kind, mask=mask)
    try:
        return array.cast(kind)
    except (pa.ArrowException, ValueError) as error:
        raise SinkError(f"the column {name} is {array.type}, not {kind}: {error}") from error
