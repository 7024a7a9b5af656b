"""This file is the adapter for types without one: rows keep their ROS shape under the last part of the type's name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from mosaico_ingest.adapters.adapter import Adapted, Envelope
from mosaico_ingest.bag.definition import Definition
from mosaico_ingest.ontology.types import OntologyType, SerializationFormat

__all__ = ["UnmodeledSpec"]

_ENVELOPE_COLUMN = "timestamp_ns"


@dataclass(frozen=True, slots=True)
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
        struct = pa.struct([field.with_name(names[field.name]) for field in shape])
        renamed = {new: old for old, new in names.items() if new != old}
        return UnmodeledAdapter(OntologyType(tag, struct, self.serialization_format), renamed)


@dataclass(frozen=True, slots=True)
class UnmodeledAdapter:
    """Hands the rows on without copying; at most a field gets another name."""

    ontology: OntologyType
    renamed: dict[str, str]
    """New name -> name in the message; only a field called like the envelope's column is in it."""

    def adapt(self, rows: pa.StructArray, envelope: Envelope) -> Adapted:  # noqa: ARG002 - the seam's signature
        """Return the same columns."""
        if self.renamed:
            rows = pa.StructArray.from_arrays(rows.flatten(), fields=list(self.ontology.struct))
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
