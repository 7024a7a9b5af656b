"""This file is clouds of points as packed records, and what the records hold."""

from __future__ import annotations

from enum import IntEnum

from mosaico_ingest.ontology.fields import UInt32
from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["PointCloud2", "PointField", "PointFieldDataType"]


class PointFieldDataType(IntEnum):
    """The type of one value of a record."""

    INT8 = 1
    UINT8 = 2
    INT16 = 3
    UINT16 = 4
    INT32 = 5
    UINT32 = 6
    FLOAT32 = 7
    FLOAT64 = 8


class PointField(Serializable):
    """One field of a record."""

    name: str
    """As `x`."""
    offset: UInt32
    """bytes from the start of the record."""
    datatype: PointFieldDataType
    """What a value is."""
    count: UInt32
    """How many values."""


class PointCloud2(Stamped, Serializable):
    """Points row by row, each a record of `point_step` bytes."""

    height: UInt32
    """rows; 1 of a cloud without order."""
    width: UInt32
    """points a row."""
    fields: list[PointField]
    """What a record holds."""
    is_bigendian: bool
    """Byte order of the records."""
    point_step: UInt32
    """bytes a point."""
    row_step: UInt32
    """bytes a row."""
    data: bytes
    """`row_step` times `height` bytes."""
    is_dense: bool
    """Whether every point is valid."""
