"""This file is the adapter for types without one: rows keep their ROS shape under the last part of the type's name."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pyarrow as pa

from mosaico_ingest.adapters.adapter import Adapted, Envelope
from mosaico_ingest.bag.definition import Definition
from mosaico_ingest.frozen import frozen
from mosaico_ingest.ontology.types import OntologyType, SerializationFormat

__all__ = ["UnmodeledSpec"]

_ENVELOPE_COLUMN = "timestamp_ns"
_ONE_MEMBER = pa.struct([("structure_needs_at_least_one_member", pa.uint8())])
"""What a nested message without fields becomes, as ROS 2 itself spells it: Parquet has no struct without fields."""


@frozen
class UnmodeledSpec:
    """Keeps a message as it is; fits every type, and is nobody's default."""

    name: str = "Unmodeled"
    ros_types: tuple[str, ...] = ()
    default: bool = False
    serialization_format: SerializationFormat = SerializationFormat.DEFAULT

    def bind(self, definition: Definition, shape: pa.StructType) -> UnmodeledAdapter:
        """Take the ROS shape for the ontology's columns; two types of one short name differ by fingerprint."""
        tag = definition.root.rsplit("/", 1)[-1]
        names = _free_of_the_envelope(shape)
        struct = pa.struct([pa.field(names[field.name], _storable(field.type)) for field in shape])
        renamed = {new: old for old, new in names.items() if new != old}
        return UnmodeledAdapter(OntologyType(tag, struct, self.serialization_format), renamed)


@frozen
class UnmodeledAdapter:
    """Hands the rows on without copying; at most fields get another name, or a member where they have none."""

    ontology: OntologyType
    renamed: dict[str, str]
    """New name -> name in the message; only a field called like the envelope's column is in it."""

    def adapt(self, rows: pa.StructArray, envelope: Envelope) -> Adapted:  # noqa: ARG002 - the seam's signature
        """Return the same columns."""
        columns = list(self.ontology.struct)
        if any(field.type != column.type for field, column in zip(rows.type, columns, strict=True)):
            rows = _with_members(rows, self.ontology.struct)
        elif self.renamed:
            rows = pa.StructArray.from_arrays(rows.flatten(), fields=columns)
        return Adapted(rows, np.arange(len(rows), dtype=np.int64), ())

    def topic_metadata(self, first_row: pa.StructScalar | None) -> dict[str, Any]:  # noqa: ARG002 - as above
        """Say which fields have another name than in the message, if any."""
        return {"renamed_fields": dict(self.renamed)} if self.renamed else {}


def _free_of_the_envelope(shape: pa.StructType) -> dict[str, str]:
    """Name each column after its field; one called `timestamp_ns` gets underscores until its name is free."""
    names = {field.name: field.name for field in shape}
    if _ENVELOPE_COLUMN in names:
        free = f"{_ENVELOPE_COLUMN}_"
        while free in names:
            free += "_"
        names[_ENVELOPE_COLUMN] = free
    return names


def _storable(kind: Any) -> pa.DataType:  # noqa: ANN401 - the stubs hide what a nested type is made of
    """Return the type with a member in every struct that has none."""
    if pa.types.is_struct(kind):
        members = [field.with_type(_storable(field.type)) for field in kind]
        return pa.struct(members) if members else _ONE_MEMBER
    if pa.types.is_fixed_size_list(kind):
        return pa.list_(kind.value_field.with_type(_storable(kind.value_type)), kind.list_size)
    if pa.types.is_list(kind):
        return pa.list_(kind.value_field.with_type(_storable(kind.value_type)))
    return kind


def _with_members(rows: Any, struct: pa.StructType) -> pa.StructArray:  # noqa: ANN401 - as above
    """Rebuild rows with the members they lack, null; through Python, since hardly a type has such fields."""
    names = [field.name for field in struct]
    renamed = [dict(zip(names, row.values(), strict=True)) for row in rows.to_pylist()]
    return cast("pa.StructArray", pa.array(renamed, type=struct))
