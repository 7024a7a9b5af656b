"""This file makes the columns of the built-in tags from `columns.json`: importing their models takes ten times as long.

The file says of each tag how it is laid out and what its columns are: the name of an Arrow type, a mapping for a
struct, a list for a list (of so many items); a name that ends in ? may be null.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import pyarrow as pa

from mosaico_ingest.ontology.types import OntologyType, SerializationFormat

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["FILE", "Written", "builtin_type", "written_fields"]

FILE = Path(__file__).with_name("columns.json")

Written: TypeAlias = "str | list[Any] | dict[str, Any]"
"""An Arrow type as the file has it."""
_arrow: Any = pa
"""The stubs know each name of a type for itself, but not `str`."""


@cache
def builtin_type(tag: str) -> OntologyType:
    """Return tag, columns and serialization format of a built-in tag; KeyError for any other."""
    known = _known()[tag]
    return OntologyType(tag, pa.struct(_fields(known["columns"])), SerializationFormat(known["format"]))


@cache
def _known() -> dict[str, dict[str, Any]]:
    return json.loads(FILE.read_bytes())


def _fields(columns: Mapping[str, Written]) -> list[pa.Field[Any]]:
    return [
        pa.field(name.removesuffix("?"), _type(kind), nullable=name.endswith("?"))
        for name, kind in columns.items()
    ]


def _type(kind: Written) -> pa.DataType:
    if isinstance(kind, str):
        return _arrow.type_for_alias(kind)
    if isinstance(kind, dict):
        return pa.struct(_fields(kind))
    return pa.list_(_type(kind[0]), *kind[1:])


def written_fields(struct: pa.StructType) -> dict[str, Written]:
    """Return the fields of a struct as the file has them."""
    return {field.name + "?" * field.nullable: _written(field.type) for field in struct}


def _written(kind: Any) -> Written:  # noqa: ANN401 - the stubs hide what a nested type is made of
    if pa.types.is_struct(kind):
        return written_fields(kind)
    if pa.types.is_fixed_size_list(kind):
        return [_written(kind.value_type), kind.list_size]
    return [_written(kind.value_type)] if pa.types.is_list(kind) else str(kind)
