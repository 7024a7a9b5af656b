"""Message encodings other than CDR and ROS 1: schemas as definitions, and single messages as dictionaries.

`MESSAGE_ENCODINGS` has one entry per encoding. The entries import their libraries when they are used.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from msgspec import Struct

from mosaico_ingest.rosbag.blocks import Encoding
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded, Language
from mosaico_ingest.rosbag.serialization import Deserializer, Serializer


class MessageReader(Protocol):
    """Converts payloads to dictionaries."""

    def to_dict(self, payload: bytes) -> dict[str, Any]:
        """Return the message's fields by name.

        Raises:
            DecodeError: The bytes are not a message of the type; `rule` is the rule id.
        """
        ...


class MessageWriter(Protocol):
    """Converts dictionaries to payloads."""

    def from_dict(self, values: Mapping[str, Any]) -> bytes:
        """Return the payload of a message in the form of `MessageReader.to_dict`.

        Raises:
            BagError: A value does not fit its field.
        """
        ...


class MessageEncoding(Struct, frozen=True):
    """The functions of one message encoding."""

    language: Language
    """The language of its schemas."""
    schema_encoding: str
    """The name of the schema's encoding in MCAP files; empty for ROS, where the definition decides."""
    read_schema: Callable[[str, Embedded | None], Definition] | None
    """Returns the definition of a type from its embedded schema, or raises BagError.

    None for ROS, whose definitions may come from elsewhere."""
    reader: Callable[[Definition], MessageReader]
    writer: Callable[[Definition], MessageWriter]


def _protobuf_schema(name: str, embedded: Embedded | None) -> Definition:
    from mosaico_ingest.rosbag.encodings.protobuf import read_schema  # noqa: PLC0415 - imports protobuf

    return read_schema(name, embedded)


def _protobuf_codec(definition: Definition) -> Any:  # noqa: ANN401 - a reader and a writer
    from mosaico_ingest.rosbag.encodings.protobuf import ProtobufCodec  # noqa: PLC0415 - imports protobuf

    return ProtobufCodec(definition)


def _json_schema(name: str, embedded: Embedded | None) -> Definition:
    from mosaico_ingest.rosbag.encodings.json_schema import read_schema  # noqa: PLC0415 - imports jsonschema

    return read_schema(name, embedded)


def _json_codec(definition: Definition) -> Any:  # noqa: ANN401 - a reader and a writer
    from mosaico_ingest.rosbag.encodings.json_messages import JsonCodec  # noqa: PLC0415 - imports jsonschema

    return JsonCodec(definition)


def _ros(encoding: Encoding) -> MessageEncoding:
    return MessageEncoding(
        Language.ROS,
        "",
        None,
        lambda definition: Deserializer(definition, encoding),
        lambda definition: Serializer(definition, encoding),
    )


MESSAGE_ENCODINGS: Mapping[Encoding, MessageEncoding] = {
    Encoding.CDR: _ros(Encoding.CDR),
    Encoding.ROS1: _ros(Encoding.ROS1),
    Encoding.PROTOBUF: MessageEncoding(
        Language.PROTOBUF, "protobuf", _protobuf_schema, _protobuf_codec, _protobuf_codec
    ),
    Encoding.JSON: MessageEncoding(
        Language.JSON_SCHEMA, "jsonschema", _json_schema, _json_codec, _json_codec
    ),
}
"""The encodings that can be read and written."""

_UNSUPPORTED = {"cbor": "CBOR", "flatbuffer": "FlatBuffers", "flatbuffers": "FlatBuffers", "xml": "XML"}


def encoding_of(definition: Definition) -> Encoding:
    """Return the encoding in which messages of a definition are written."""
    if definition.language is Language.ROS:
        return Encoding.ROS1 if definition.ros_version == 1 else Encoding.CDR
    return next(
        encoding for encoding, entry in MESSAGE_ENCODINGS.items() if entry.language is definition.language
    )


def refusal(name: str) -> str:
    """Return why messages of an encoding cannot be decoded."""
    supported = ", ".join(encoding.value for encoding in MESSAGE_ENCODINGS)
    title = f" ({_UNSUPPORTED[name.lower()]})" if name.lower() in _UNSUPPORTED else ""
    return f"its message encoding is {name!r}{title}; supported are {supported}"
