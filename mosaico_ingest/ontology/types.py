"""Ontology types as the pipeline carries them: tag, format, exact Arrow columns and required fields."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, TypeAlias, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.types as pt
from msgspec import Struct

from mosaico_ingest.lazy import cache_by_identity

PLAIN_TYPES: Mapping[pa.DataType, pa.DataType] = {
    pa.large_string(): pa.string(),
    pa.string_view(): pa.string(),
    pa.large_binary(): pa.binary(),
    pa.binary_view(): pa.binary(),
}
"""The plain type of texts and bytes by their large and view types."""


class SerializationFormat(str, Enum):
    """The layout of a topic on the platform."""

    DEFAULT = "default"
    RAGGED = "ragged"
    IMAGE = "image"


class OntologyType(Struct, frozen=True):
    """The type of a topic's rows; `struct` has every column except `timestamp_ns`."""

    tag: str
    struct: pa.StructType
    serialization_format: SerializationFormat = SerializationFormat.DEFAULT

    @property
    def fingerprint(self) -> str:
        """Identifier of the columns, which readers compare."""
        return fingerprint(self.struct)


@cache_by_identity
def fingerprint(struct: pa.StructType) -> str:
    """Return the first ten hex digits of the SHA-1 of the struct's text; top-level large and view types count as plain."""
    fields = [
        pa.field(field.name, PLAIN_TYPES.get(field.type) or field.type, field.nullable) for field in struct
    ]
    return hashlib.sha1(str(pa.struct(fields)).encode(), usedforsecurity=False).hexdigest()[:10]


_arrays: Any = pa
"""pyarrow, whose stubs do not accept `type` together with `mask`."""
_KEPT_BYTES = 1 << 20
_Fill: TypeAlias = Callable[[Any], Any]
"""Fills an array, or returns it unchanged if there is nothing to fill."""


class RequiredFields:
    """Fills the required fields of a struct type; the constructor finds them once for all batches of a topic."""

    def __init__(self, kind: pa.StructType) -> None:
        self._fill = _fill_of(kind)

    def fill(self, rows: pa.StructArray) -> pa.StructArray:
        """Return the rows with zeros in required fields that are null because their struct is null.

        No value that can be seen changes. Parquet's writer refuses `struct<a: int32 not null>` with a null in `a`
        although the struct itself is null there.
        """
        return rows if self._fill is None else cast("pa.StructArray", self._fill(rows))  # a struct stays one


class NullRows:
    """Null rows of one type, with zeros in required fields; small arrays are built once."""

    def __init__(self, kind: Any) -> None:  # noqa: ANN401 - any Arrow type; the stubs have no common base with children
        self._kind = kind
        self._fill = _fill_of(kind)
        self._kept: Any = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without the cached rows."""
        return NullRows, (self._kind,)

    def of(self, count: int) -> Any:  # noqa: ANN401 - an Arrow array
        """Return `count` null rows."""
        if self._kept is not None and count <= len(self._kept):
            return self._kept.slice(0, count)
        rows: Any = pa.nulls(count, self._kind)
        rows = rows if self._fill is None else self._fill(rows)
        if rows.nbytes <= _KEPT_BYTES:
            self._kept = rows
        return rows


def _fill_of(kind: Any) -> _Fill | None:  # noqa: ANN401 - any Arrow type
    """Return a function that fills arrays of a type, None if nothing inside is required."""
    if pt.is_struct(kind):
        return _struct_fill(list(kind))
    if pt.is_fixed_size_list(kind):
        inner = _fill_of(kind.value_type)
        return None if inner is None else lambda array: _fill_fixed(array, inner)
    if pt.is_list(kind):
        inner = _fill_of(kind.value_type)
        return None if inner is None else lambda array: _fill_list(array, inner)
    return None


def _struct_fill(fields: list[pa.Field[Any]]) -> _Fill | None:
    inner = [_fill_of(field.type) for field in fields]
    watched = [
        (position, fill, field.nullable)
        for position, (field, fill) in enumerate(zip(fields, inner, strict=True))
        if fill is not None or not field.nullable
    ]

    def fill_struct(array: Any) -> Any:  # noqa: ANN401 - an Arrow array
        new_children: dict[int, Any] = {}
        for position, fill, nullable in watched:
            child = array.field(position)
            new = child if fill is None else fill(child)
            if not nullable and child.null_count:
                new = _without_nulls(new)
            if new is not child:
                new_children[position] = new
        if not new_children:
            return array
        children = [new_children[i] if i in new_children else array.field(i) for i in range(len(fields))]
        mask = pc.is_null(array) if array.null_count else None
        return pa.StructArray.from_arrays(children, fields=fields, mask=mask)

    return fill_struct if watched else None


def _fill_fixed(array: Any, fill: _Fill) -> Any:  # noqa: ANN401 - an Arrow array
    size = array.type.list_size
    values = array.values.slice(array.offset * size, len(array) * size)
    filled = fill(values)
    if filled is values:
        return array
    mask = pc.is_null(array) if array.null_count else None
    return _arrays.FixedSizeListArray.from_arrays(filled, type=array.type, mask=mask)


def _fill_list(array: Any, fill: _Fill) -> Any:  # noqa: ANN401 - an Arrow array
    values = array.values
    filled = fill(values)
    if filled is values:
        return array
    # A null offset is a null list; `mask` does not go with a slice.
    absent = np.append(array.is_null().to_numpy(zero_copy_only=False), False)
    offsets = pa.array(array.offsets.to_numpy(), pa.int32(), mask=absent)
    return pa.ListArray.from_arrays(offsets, filled, type=array.type)


def _without_nulls(array: Any) -> Any:  # noqa: ANN401 - an Arrow array
    """Return the values without their null mask."""
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
