"""This file is an ontology type as the pipeline carries it: a tag, a format and exact Arrow columns."""

from __future__ import annotations

import hashlib
from enum import Enum

import pyarrow as pa

from mosaico_ingest.frozen import frozen
from mosaico_ingest.remembered import remembered

__all__ = ["OntologyType", "SerializationFormat", "fingerprint"]


_PLAIN: dict[pa.DataType, pa.DataType] = {
    pa.large_string(): pa.string(),
    pa.string_view(): pa.string(),
    pa.large_binary(): pa.binary(),
    pa.binary_view(): pa.binary(),
}


class SerializationFormat(str, Enum):
    """How the platform lays a topic out."""

    DEFAULT = "default"
    RAGGED = "ragged"
    IMAGE = "image"


@frozen
class OntologyType:
    """What a topic's rows are; `struct` has every column but `timestamp_ns`."""

    tag: str
    struct: pa.StructType
    serialization_format: SerializationFormat = SerializationFormat.DEFAULT

    @property
    def fingerprint(self) -> str:
        """The name readers know these columns by."""
        return fingerprint(self.struct)


@remembered
def fingerprint(struct: pa.StructType) -> str:
    """Return the first ten hex digits of the SHA-1 of the struct's spelling; top-level large and view types count as plain."""
    fields = [pa.field(field.name, _PLAIN.get(field.type) or field.type, field.nullable) for field in struct]
    return hashlib.sha1(str(pa.struct(fields)).encode(), usedforsecurity=False).hexdigest()[:10]
