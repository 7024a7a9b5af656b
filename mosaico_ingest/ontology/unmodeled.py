"""This file is rows of any shape, for message types without a model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pyarrow as pa
from typing_extensions import Self

from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["Unmodeled"]


class Unmodeled(Serializable):
    """A row kept in the shape of its message; its topic's columns are those of the message type."""

    raw_data: dict[str, Any]
    """The columns' values."""

    def to_row(self) -> dict[str, Any]:
        """Return the values of the columns."""
        return self.raw_data

    @classmethod
    def from_row(cls, row: Mapping[str, Any]) -> Self:
        """Return the row as it is."""
        return cls(raw_data=dict(row))

    @classmethod
    def _columns(cls) -> pa.StructType:
        return pa.struct([])
