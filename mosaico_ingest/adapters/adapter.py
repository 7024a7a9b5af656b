"""The adapter protocol, the metadata of adapted topics, and the adapters for unmodeled types and image files."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any, Protocol, cast

import numpy as np
import pyarrow as pa
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.errors import AdapterError, ViewError
from mosaico_ingest.findings import RowFailure
from mosaico_ingest.job.fields import ImageSettings
from mosaico_ingest.ontology.registry import OntologyType, SerializationFormat
from mosaico_ingest.rosbag.definitions.model import Definition, Language
from mosaico_ingest.rosbag.encodings import MESSAGE_ENCODINGS, encoding_of

ROS_METADATA_KEY = "_ros_"
"""Reserved key: it takes precedence over the same key in the user's topic metadata."""
MCAP_METADATA_KEY = "_mcap_"
"""Reserved key of topics in other encodings than those of ROS, with the same members as in the official SDK."""
RESERVED_KEYS = frozenset({ROS_METADATA_KEY, MCAP_METADATA_KEY})
_ENVELOPE_COLUMN = "timestamp_ns"
_ONE_MEMBER = pa.struct([("structure_needs_at_least_one_member", pa.uint8())])
"""Type of a nested message without fields, named as in ROS 2: Parquet has no structs without fields."""
_MEMBERS = {
    ROS_METADATA_KEY: ("msgtype", "msgdef", "source_file"),
    MCAP_METADATA_KEY: ("schema_name", "schema_def", "source_file", "channel_encoding"),
}
IMAGE_TAG = "Image"
"""The tag of the ontology type whose rows can be stored as image files."""
_FILES = frozenset({"png", "jpeg", "jpg", "tiff"})
"""Formats whose `data` is an image file."""


def source_metadata(definition: Definition, source_file: str, *, topic: str) -> dict[str, Any]:
    """Return the metadata that describes the original messages of a topic."""
    if definition.language is Language.ROS:
        return ros_metadata(definition, source_file)
    encoding = encoding_of(definition)
    return {
        MCAP_METADATA_KEY: {
            "channel_name": topic,
            "channel_encoding": encoding.value,
            "schema_name": definition.root,
            "schema_encoding": MESSAGE_ENCODINGS[encoding].schema_encoding if definition.text else "",
            "schema_def": definition.text,
            "enums": _enums(definition),
            "source_file": source_file,
        }
    }


class RecordedSchema(Struct, frozen=True):
    """The schema of a topic's original messages, from its metadata."""

    msgtype: str
    text: str
    """As in `Definition.text`."""
    source_file: str
    language: Language = Language.ROS


def recorded_schema(metadata: Mapping[str, Any]) -> RecordedSchema | None:
    """Return the schema of a topic's original messages; None if the metadata does not describe it."""
    for key, members in _MEMBERS.items():
        block = metadata.get(key)
        if not isinstance(block, Mapping):
            continue
        values = cast("Mapping[str, Any]", block)
        texts = [values.get(member, "") for member in members]
        if not all(isinstance(text, str) for text in texts) or not texts[0]:
            return None
        languages = {encoding.value: entry.language for encoding, entry in MESSAGE_ENCODINGS.items()}
        language = languages.get(texts[3]) if key == MCAP_METADATA_KEY else Language.ROS
        return None if language is None else RecordedSchema(texts[0], texts[1], texts[2], language)
    return None


def ros_metadata(definition: Definition, source_file: str) -> dict[str, Any]:
    """Return `{"_ros_": {msgtype, enums, msgdef, source_file}}`; enums are the constants of the type itself.

    A constant that is not a finite number is spelled `NaN`, `Infinity` or `-Infinity`: JSON has no number for it.
    """
    return {
        ROS_METADATA_KEY: {
            "msgtype": definition.root,
            "enums": _enums(definition),
            "msgdef": definition.text,
            "source_file": source_file,
        }
    }


def _enums(definition: Definition) -> dict[str, object]:
    return {constant.name: _json_value(constant.value) for constant in definition.message.constants}


def _json_value(value: object) -> object:
    if not isinstance(value, float) or math.isfinite(value):
        return value
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


class Envelope(Struct, frozen=True):
    """Properties of a batch of rows besides their content."""

    topic: str
    msgtype: str
    log_times: NDArray[np.int64]
    """Log times in ns since the epoch, shape (n,)."""
    publish_times: NDArray[np.int64] | None = None
    """Publish times in ns since the epoch, shape (n,); None if they equal the log times."""
    sequences: NDArray[np.int64] | None = None
    """Sequence numbers, shape (n,); None if all are 0."""
    indices: NDArray[np.int64] | None = None
    """Positions of the messages in their topic, shape (n,); None if the batch starts with the topic."""

    def take(self, rows: NDArray[Any]) -> Envelope:
        """Return the envelope of some rows, given by a mask or by positions."""
        return Envelope(
            self.topic,
            self.msgtype,
            self.log_times[rows],
            None if self.publish_times is None else self.publish_times[rows],
            None if self.sequences is None else self.sequences[rows],
            None if self.indices is None else self.indices[rows],
        )


class Adapted(Struct, frozen=True):
    """The result of adapting a batch: the rows that fit, and the failures."""

    rows: pa.StructArray
    """The adapted rows; their type is the ontology's struct."""
    index: NDArray[np.int64]
    """Positions of the rows' messages in the batch, ascending, shape (len(rows),); several rows can have one message."""
    failures: tuple[RowFailure, ...]
    """The rejected messages; no output has a row of them."""
    log_times: NDArray[np.int64] | None = None
    """Times to store instead of the log times, shape (len(rows),); only a `translate` in Python changes them."""
    dropped: Mapping[str, NDArray[np.int64]] = {}
    """Positions of the messages that have no row in any output, by the rule that drops them."""
    others: tuple[Adapted, ...] = ()
    """The rows of the other outputs of the adapter; their failures and dropped messages are the same."""

    @property
    def messages(self) -> NDArray[np.int64]:
        """Positions of the messages that have a row in any output, ascending."""
        if self.others:
            return np.unique(np.concatenate([self.index, *(one.index for one in self.others)]))
        first = np.ones(len(self.index), bool)
        first[1:] = self.index[1:] != self.index[:-1]
        return self.index if first.all() else self.index[first]


class Adapter(Protocol):
    """An adapter bound to one message definition."""

    @property
    def ontology(self) -> OntologyType:
        """The ontology type of the adapted rows."""
        ...

    def adapt(self, rows: pa.StructArray, envelope: Envelope) -> Adapted:
        """Adapt a batch; rows that do not fit become failures.

        Raises:
            AdapterError: The adapter itself fails, so no row can be adapted.
        """
        ...

    def topic_metadata(self, first_row: pa.StructScalar | None) -> dict[str, Any]:
        """Return topic metadata read from the first row; {} without any."""
        ...


class AdapterSpec(Protocol):
    """An adapter that is not yet bound to a definition: cheap, picklable, and held by registries and plans."""

    @property
    def name(self) -> str:
        """The adapter's name, such as `IMUAdapter`."""
        ...

    @property
    def ros_types(self) -> tuple[str, ...]:
        """The message types that the adapter takes, such as `sensor_msgs/msg/Imu`."""
        ...

    @property
    def default(self) -> bool:
        """Whether the adapter applies to its types without an override."""
        ...

    def bind(self, definition: Definition, shape: pa.StructType) -> Adapter:
        """Check the adapter against a message definition, and prepare it.

        Raises:
            AdapterError: A required field is missing or has another type.
        """
        ...


def short_name(msgtype: str) -> str:
    """Return the last part of a type's name, without its package; characters that no tag can have become `_`."""
    return re.sub(r"\W", "_", re.split(r"[/.]", msgtype)[-1]) or "Message"


class UnmodeledSpec(Struct, frozen=True):
    """Keeps messages in their ROS shape; takes every type, and is not the default of any."""

    name: str = "Unmodeled"
    ros_types: tuple[str, ...] = ()
    default: bool = False
    serialization_format: SerializationFormat = SerializationFormat.DEFAULT

    def bind(self, definition: Definition, shape: pa.StructType) -> UnmodeledAdapter:
        """Use the ROS shape as ontology columns; types with the same short name differ by fingerprint."""
        tag = short_name(definition.root)
        names = _free_of_the_envelope(shape)
        struct = pa.struct([pa.field(names[field.name], _storable(field.type)) for field in shape])
        renamed = {new: old for old, new in names.items() if new != old}
        return UnmodeledAdapter(OntologyType(tag, struct, self.serialization_format), renamed)


class UnmodeledAdapter(Struct, frozen=True):
    """Returns rows without copying, except that it renames fields and completes structs without fields."""

    ontology: OntologyType
    renamed: dict[str, str]
    """Column name → field name, for a field that has the name of the envelope's column."""

    def adapt(self, rows: pa.StructArray, envelope: Envelope) -> Adapted:  # noqa: ARG002 - the protocol's signature
        """Return the same columns."""
        columns = list(self.ontology.struct)
        if any(field.type != column.type for field, column in zip(rows.type, columns, strict=True)):
            rows = _with_members(rows, self.ontology.struct)
        elif self.renamed:
            rows = pa.StructArray.from_arrays(rows.flatten(), fields=columns)
        return Adapted(rows, np.arange(len(rows), dtype=np.int64), ())

    def topic_metadata(self, first_row: pa.StructScalar | None) -> dict[str, Any]:  # noqa: ARG002 - the protocol's signature
        """Return the renamed fields, if any."""
        return {"renamed_fields": dict(self.renamed)} if self.renamed else {}


def _free_of_the_envelope(shape: pa.StructType) -> dict[str, str]:
    """Return the column name of each field: `timestamp_ns` gets underscores until its name is unique."""
    names = {field.name: field.name for field in shape}
    if _ENVELOPE_COLUMN in names:
        free = f"{_ENVELOPE_COLUMN}_"
        while free in names:
            free += "_"
        names[_ENVELOPE_COLUMN] = free
    return names


def _storable(kind: Any) -> pa.DataType:  # noqa: ANN401 - the stubs hide the members of nested types
    """Return the type with a placeholder field in every struct without fields."""
    if pa.types.is_struct(kind):
        members = [field.with_type(_storable(field.type)) for field in kind]
        return pa.struct(members) if members else _ONE_MEMBER
    if pa.types.is_fixed_size_list(kind):
        return pa.list_(kind.value_field.with_type(_storable(kind.value_type)), kind.list_size)
    if pa.types.is_list(kind):
        return pa.list_(kind.value_field.with_type(_storable(kind.value_type)))
    return kind


def _with_members(rows: Any, struct: pa.StructType) -> pa.StructArray:  # noqa: ANN401 - the stubs lack methods of struct arrays
    """Rebuild rows with null placeholder fields. It runs in Python, because such types are rare."""
    names = [field.name for field in struct]
    renamed = [dict(zip(names, row.values(), strict=True)) for row in rows.to_pylist()]
    return cast("pa.StructArray", pa.array(renamed, type=struct))


class EncodedImageSpec(Struct, frozen=True):
    """Stores the raw images of an adapter as image files; adapters of other ontology types are unchanged."""

    inner: AdapterSpec
    settings: ImageSettings

    @property
    def name(self) -> str:
        """The inner adapter's name."""
        return self.inner.name

    @property
    def ros_types(self) -> tuple[str, ...]:
        """The inner adapter's types."""
        return self.inner.ros_types

    @property
    def default(self) -> bool:
        """Whether the inner adapter is the default of its types."""
        return self.inner.default

    def bind(self, definition: Definition, shape: pa.StructType) -> Adapter:
        """Bind the inner adapter.

        Raises:
            AdapterError: As in the inner adapter.
            IngestError: The format requires Pillow, which is not installed.
        """
        adapter = self.inner.bind(definition, shape)
        if adapter.ontology.tag != IMAGE_TAG:
            return adapter
        from mosaico_ingest.adapters.encoded_images import encoded_images  # noqa: PLC0415 - only this setting needs it

        return encoded_images(adapter, self.settings)


def without_files(rows: pa.StructArray) -> pa.StructArray:
    """Return images as raw buffers; images that are stored as image files are decoded.

    Raises:
        AdapterError: A file is damaged.
        IngestError: Pillow is not installed.
    """
    columns = {field.name: rows.field(field.name) for field in rows.type}
    formats = columns["format"].to_pylist()
    if not _FILES.intersection(formats):
        return rows
    data = [
        _decoded(value.as_py()) if formats[row] in _FILES else memoryview(value.as_buffer())
        for row, value in enumerate(columns["data"])
    ]
    names = ["raw" if name in _FILES else name for name in formats]
    columns["data"] = pa.array(data, rows.type.field("data").type)
    columns["format"] = pa.array(names, rows.type.field("format").type)
    return pa.StructArray.from_arrays(list(columns.values()), fields=list(rows.type))


def _decoded(file: bytes) -> bytes:
    from mosaico_ingest.images import decoded_buffer  # noqa: PLC0415 - only image files need it

    try:
        return decoded_buffer(file)
    except ViewError as error:
        raise AdapterError(error.what) from error
