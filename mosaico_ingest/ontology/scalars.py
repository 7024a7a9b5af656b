"""Single values without a header, and rows of any shape."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pyarrow as pa
from typing_extensions import Self

from mosaico_ingest.ontology.model import (
    Float16,
    Float32,
    Float64,
    Int8,
    Int16,
    Int32,
    Int64,
    Serializable,
    UInt8,
    UInt16,
    UInt32,
    UInt64,
)


class Boolean(Serializable):
    """A boolean."""

    data: bool
    """The value."""


class Floating16(Serializable):
    """A half-precision number."""

    data: Float16
    """The value."""


class Floating32(Serializable):
    """A single-precision number."""

    data: Float32
    """The value."""


class Floating64(Serializable):
    """A double-precision number."""

    data: Float64
    """The value."""


class Integer8(Serializable):
    """A signed 8-bit integer."""

    data: Int8
    """The value."""


class Integer16(Serializable):
    """A signed 16-bit integer."""

    data: Int16
    """The value."""


class Integer32(Serializable):
    """A signed 32-bit integer."""

    data: Int32
    """The value."""


class Integer64(Serializable):
    """A signed 64-bit integer."""

    data: Int64
    """The value."""


class Unsigned8(Serializable):
    """An unsigned 8-bit integer."""

    data: UInt8
    """The value."""


class Unsigned16(Serializable):
    """An unsigned 16-bit integer."""

    data: UInt16
    """The value."""


class Unsigned32(Serializable):
    """An unsigned 32-bit integer."""

    data: UInt32
    """The value."""


class Unsigned64(Serializable):
    """An unsigned 64-bit integer."""

    data: UInt64
    """The value."""


class String(Serializable):
    """A UTF-8 text."""

    data: str
    """The value."""


class Unmodeled(Serializable):
    """A row in the shape of its ROS message; the columns depend on the message type."""

    raw_data: dict[str, Any]
    """The values of the columns."""

    def to_row(self) -> dict[str, Any]:
        """Return the values of the columns."""
        return self.raw_data

    @classmethod
    def from_row(cls, row: Mapping[str, Any]) -> Self:
        """Return the model of a row."""
        return cls(raw_data=dict(row))

    @classmethod
    def _columns(cls) -> pa.StructType:
        return pa.struct([])
