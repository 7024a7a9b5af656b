"""The adapter protocol, the metadata of adapted topics, and the adapter for unmodeled types."""

from __future__ import annotations

import math
from typing import Any, Protocol, cast

import numpy as np
import pyarrow as pa
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.findings import RowFailure
from mosaico_ingest.ontology.types import OntologyType, SerializationFormat
from mosaico_ingest.rosbag.definitions.model import Definition

__all__ = [
    "ROS_METADATA_KEY",
    "Adapted",
    "Adapter",
    "AdapterSpec",
    "Envelope",
    "UnmodeledSpec",
    "ros_metadata",
]

ROS_METADATA_KEY = "_ros_"
"""Reserved: it wins over a key of the same name in the user's own topic metadata."""


def ros_metadata(definition: Definition, source_file: str) -> dict[str, Any]:
    """Return `{"_ros_": {msgtype, enums, msgdef, source_file}}`; enums are the constants of the type itself.

    A constant that is not a finite number is spelled `NaN`, `Infinity` or `-Infinity`: JSON has no number for it.
    """
    return {
        ROS_METADATA_KEY: {
            "msgtype": definition.root,
            "enums": {
                constant.name: _json_value(constant.value) for constant in definition.message.constants
            },
            "msgdef": definition.text,
            "source_file": source_file,
        }
    }


def _json_value(value: object) -> object:
    if not isinstance(value, float) or math.isfinite(value):
        return value
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


class Envelope(Struct, frozen=True):
    """What is known of the rows beside their content."""

    topic: str
    msgtype: str
    log_times: NDArray[np.int64]
    """ns since the epoch, shape (n,)."""


class Adapted(Struct, frozen=True):
    """The rows that fit, which of the given rows they were, and the ones that did not."""

    rows: pa.StructArray
    """Type = the ontology's struct."""
    index: NDArray[np.int64]
    """Position among the given rows, ascending, shape (len(rows),)."""
    failures: tuple[RowFailure, ...]
    log_times: NDArray[np.int64] | None = None
    """Times to store instead of the recorded ones, shape (len(rows),); only a Python `translate` changes them."""


class Adapter(Protocol):
    """An adapter bound to one message definition."""

    @property
    def ontology(self) -> OntologyType:
        """What the rows become."""
        ...

    def adapt(self, rows: pa.StructArray, envelope: Envelope) -> Adapted:
        """Adapt a whole batch; a row that does not fit is a failure, the others go on.

        Raises:
            AdapterError: The adapter itself is broken; no row can be adapted.
        """
        ...

    def topic_metadata(self, first_row: pa.StructScalar | None) -> dict[str, Any]:
        """Return what the platform should know of the topic's configuration; {} by default."""
        ...


class AdapterSpec(Protocol):
    """An adapter before it meets a definition: cheap, picklable, what registries and plans hold."""

    @property
    def name(self) -> str:
        """As `IMUAdapter`."""
        ...

    @property
    def ros_types(self) -> tuple[str, ...]:
        """The message types it takes, as `sensor_msgs/msg/Imu`."""
        ...

    @property
    def default(self) -> bool:
        """Whether it is used for its types without being asked for."""
        ...

    def bind(self, definition: Definition, shape: pa.StructType) -> Adapter:
        """Check the adapter against the real definition and make it ready.

        Raises:
            AdapterError: A field it needs is not there or has another type; names the fields that are.
        """
        ...


_ENVELOPE_COLUMN = "timestamp_ns"
_ONE_MEMBER = pa.struct([("structure_needs_at_least_one_member", pa.uint8())])
"""What a nested message without fields becomes, as ROS 2 itself spells it: Parquet has no struct without fields."""


class UnmodeledSpec(Struct, frozen=True):
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


class UnmodeledAdapter(Struct, frozen=True):
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
