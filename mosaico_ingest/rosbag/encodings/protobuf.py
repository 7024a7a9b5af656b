"""Protobuf: FileDescriptorSets as definitions, and messages as dictionaries.

A message becomes a struct with one field per protobuf field, in the order of the declaration:

* A field with presence (`optional`, members of a `oneof`, messages, proto2) is null if it is absent. Any other field
  has its default value.
* An enum is its number as int32; its values are constants of the message. A `map` is a list of `{key, value}`.
* Wrappers such as `google.protobuf.DoubleValue` become their value. `Struct`, `Value`, `ListValue` and messages that
  contain themselves become JSON text.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from enum import Enum
from functools import lru_cache
from typing import Any

import pyarrow as pa
from google.protobuf import descriptor_pool, json_format, message_factory
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import DecodeError as WireError
from google.protobuf.message import EncodeError, Message
from msgspec import Struct

from mosaico_ingest.errors import BagError, DecodeError
from mosaico_ingest.rosbag.definitions.model import (
    Constant,
    Container,
    Definition,
    Embedded,
    Field,
    Language,
    MessageType,
    Source,
)

_MAX_COLUMNS = 20_000
_PACKAGE = "google.protobuf."
_WRAPPERS = {
    f"{_PACKAGE}{name}Value"
    for name in ("Double", "Float", "Int64", "UInt64", "Int32", "UInt32", "Bool", "String", "Bytes")
}
_DYNAMIC = {f"{_PACKAGE}{name}" for name in ("Struct", "Value", "ListValue")}
_CPP = FieldDescriptor
_TYPES: Mapping[int, tuple[str, pa.DataType]] = {
    _CPP.CPPTYPE_INT32: ("int32", pa.int32()),
    _CPP.CPPTYPE_INT64: ("int64", pa.int64()),
    _CPP.CPPTYPE_UINT32: ("uint32", pa.uint32()),
    _CPP.CPPTYPE_UINT64: ("uint64", pa.uint64()),
    _CPP.CPPTYPE_DOUBLE: ("float64", pa.float64()),
    _CPP.CPPTYPE_FLOAT: ("float32", pa.float32()),
    _CPP.CPPTYPE_BOOL: ("bool", pa.bool_()),
    _CPP.CPPTYPE_ENUM: ("int32", pa.int32()),
    _CPP.CPPTYPE_STRING: ("string", pa.string()),
}


class Form(Enum):
    """How a field becomes a column."""

    SCALAR = "scalar"
    MESSAGE = "message"
    WRAPPER = "wrapper"
    """A message that becomes its only field, `value`."""
    JSON = "json"
    """A message that becomes JSON text."""


def read_schema(name: str, embedded: Embedded | None) -> Definition:
    """Return the definition of a message type from a FileDescriptorSet.

    Raises:
        BagError: There is no schema, it is not a FileDescriptorSet with this type, or it has too many fields.
    """
    if embedded is None or embedded.encoding != "protobuf":
        schema = "no schema" if embedded is None else f"a schema in {embedded.encoding!r}"
        raise BagError(f"the protobuf channel has {schema}; it needs a FileDescriptorSet", where=name or None)
    descriptor = _descriptor(name, embedded.text)
    types: dict[str, MessageType] = {}
    _add_types(descriptor, types)
    shape = _struct(descriptor, _Budget())
    return Definition(name, types, Source.BAG, embedded.text, 0, Language.PROTOBUF, shape)


def descriptor_of(definition: Definition) -> Descriptor:
    """Return the descriptor of a definition's root type."""
    return _descriptor(definition.root, definition.text)


def message_class(definition: Definition) -> type[Message]:
    """Return the class of a definition's messages."""
    return message_factory.GetMessageClass(descriptor_of(definition))


@lru_cache(maxsize=128)
def _descriptor(name: str, text: str) -> Descriptor:
    try:
        files = FileDescriptorSet.FromString(Embedded("protobuf", text).to_bytes())
    except (WireError, ValueError) as error:
        raise BagError(f"the schema is not a FileDescriptorSet: {error}", where=name) from error
    pool = descriptor_pool.DescriptorPool()
    try:
        _add_files(pool, {file.name: file for file in files.file})
        return pool.FindMessageTypeByName(name)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise BagError(f"the FileDescriptorSet does not define {name}: {error}", where=name) from error


def _add_files(pool: Any, files: dict[str, Any]) -> None:  # noqa: ANN401 - a DescriptorPool
    """Add files to a pool, each after the files that it imports."""
    paths: set[str] = set()

    def add(path: str) -> None:
        if path in paths:
            return
        paths.add(path)
        file = files.get(path) or _well_known(path)
        for imported in file.dependency:
            add(imported)
        pool.Add(file)

    for path in files:
        add(path)


def _well_known(path: str) -> Any:  # noqa: ANN401 - a FileDescriptorProto
    """Return a file of `google/protobuf`, which some writers omit."""
    from google.protobuf import (  # noqa: PLC0415 - registers the files; few recordings omit them
        any_pb2,
        descriptor_pb2,
        duration_pb2,
        empty_pb2,
        field_mask_pb2,
        struct_pb2,
        timestamp_pb2,
        wrappers_pb2,
    )

    modules = (any_pb2, duration_pb2, empty_pb2, field_mask_pb2, struct_pb2, timestamp_pb2, wrappers_pb2)
    for module in modules:
        if module.DESCRIPTOR.name == path:
            file = descriptor_pb2.FileDescriptorProto()
            module.DESCRIPTOR.CopyToProto(file)
            return file
    raise KeyError(f"it lacks the imported file {path}")


def message_type(field: FieldDescriptor) -> Descriptor:
    """Return the type of a field's messages."""
    if field.message_type is None:
        raise TypeError(f"{field.full_name} is not a message")
    return field.message_type


def form_of(field: FieldDescriptor) -> Form:
    """Return how a field becomes a column."""
    message = field.message_type
    if message is None:
        return Form.SCALAR
    if message.GetOptions().map_entry:
        return Form.MESSAGE
    if message.full_name in _WRAPPERS:
        return Form.WRAPPER
    if message.full_name in _DYNAMIC or _reaches(message, _owner(field)):
        return Form.JSON
    return Form.MESSAGE


def _owner(field: FieldDescriptor) -> Descriptor:
    if field.containing_type is None:
        raise TypeError(f"{field.full_name} is an extension")
    return field.containing_type


def _reaches(start: Descriptor, goal: Descriptor) -> bool:
    """Return whether a message contains messages of another type, at any depth; a type contains itself."""
    return any(message.full_name == goal.full_name for message in _messages_in(start))


class _Budget:
    """Counts columns, of which a few lines of nested messages could define millions."""

    def __init__(self) -> None:
        self.columns = 0

    def add(self, message: Descriptor) -> None:
        self.columns += len(message.fields)
        if self.columns > _MAX_COLUMNS:
            raise BagError(f"more than {_MAX_COLUMNS} fields", where=message.full_name)


def _struct(message: Descriptor, budget: _Budget) -> pa.StructType:
    budget.add(message)
    return pa.struct([pa.field(field.name, _column(field, budget)) for field in message.fields])


def _column(field: FieldDescriptor, budget: _Budget) -> pa.DataType:
    item = _struct(message_type(field), budget) if form_of(field) is Form.MESSAGE else arrow_type(field)
    if not field.is_repeated:
        return item
    return pa.list_(pa.field(field.name if pa.types.is_struct(item) else "item", item))


def arrow_type(field: FieldDescriptor) -> pa.DataType:
    """Return the type of one value of a field that is not a plain message."""
    return _type_of(field)[1]


def _type_of(field: FieldDescriptor) -> tuple[str, pa.DataType]:
    form = form_of(field)
    if form is Form.JSON:
        return "json", pa.string()
    if form is Form.WRAPPER:
        return _type_of(message_type(field).fields_by_name["value"])
    if field.type == FieldDescriptor.TYPE_BYTES:
        return "binary", pa.binary()
    return _TYPES[field.cpp_type]


def _add_types(message: Descriptor, types: dict[str, MessageType]) -> None:
    """Add a message type and all types that its columns contain."""
    if message.full_name in types:
        return
    types[message.full_name] = MessageType(
        message.full_name, tuple(map(_field, message.fields)), tuple(_constants(message))
    )
    for field in message.fields:
        if form_of(field) is Form.MESSAGE:
            _add_types(message_type(field), types)


def _field(field: FieldDescriptor) -> Field:
    container = Container.SEQUENCE if field.is_repeated else Container.SCALAR
    if form_of(field) is Form.MESSAGE:
        name = message_type(field).full_name
        return Field(field.name, name, is_message=True, container=container, is_required=field.is_required)
    return Field(field.name, _type_of(field)[0], container=container, is_required=field.is_required)


def _constants(message: Descriptor) -> Iterator[Constant]:
    """Yield the values of the enums of a message's fields; a name with two meanings is preceded by its enum's name."""
    values: dict[str, int] = {}
    for enum in {
        field.enum_type.full_name: field.enum_type for field in message.fields if field.enum_type
    }.values():
        for value in enum.values:
            name = value.name
            if values.get(name, value.number) != value.number:
                name = f"{enum.name}_{name}"
            if name not in values:
                values[name] = value.number
                yield Constant(name, "int32", value.number)


def requires_fields(message: Descriptor) -> bool:
    """Return whether a message or a message in it has required fields, which only proto2 has."""
    return any(field.is_required for each in _messages_in(message) for field in each.fields)


def _messages_in(message: Descriptor) -> Iterator[Descriptor]:
    """Yield a message type and the types of all messages in it, at any depth."""
    visited: set[str] = set()
    waiting = [message]
    while waiting:
        each = waiting.pop()
        if each.full_name not in visited:
            visited.add(each.full_name)
            yield each
            waiting += [field.message_type for field in each.fields if field.message_type is not None]


class ProtobufCodec:
    """Converts single messages of one definition with Google's parser."""

    def __init__(self, definition: Definition) -> None:
        self._class = message_class(definition)
        descriptor = descriptor_of(definition)
        self._read = _reader(descriptor)
        self._write = _writer(descriptor)
        self._is_checked = requires_fields(descriptor)

    def to_dict(self, payload: bytes) -> dict[str, Any]:
        """Return the message's fields by name.

        Raises:
            DecodeError: The bytes are not a message of this type.
        """
        try:
            message = self._class.FromString(payload)
        except WireError as error:
            raise DecodeError(
                f"the bytes are not valid protobuf: {_reason(error)}", rule="protobuf"
            ) from None
        if self._is_checked and not message.IsInitialized():
            unset: Any = message  # the stubs lack the method
            missing = ", ".join(unset.FindInitializationErrors())
            raise DecodeError(f"required fields are missing: {missing}", rule="protobuf")
        try:
            return self._read(message)
        except UnicodeDecodeError as error:
            raise DecodeError(f"byte {error.start} of a string is not UTF-8", rule="utf8") from None
        except (json_format.Error, ValueError, RecursionError) as error:
            raise DecodeError(f"a value has no JSON form: {error}", rule="protobuf") from None

    def from_dict(self, values: Mapping[str, Any]) -> bytes:
        """Return the payload of a message in the form that `to_dict` returns.

        Raises:
            BagError: A value does not fit its field.
        """
        message = self._class()
        name = message.DESCRIPTOR.full_name
        try:
            self._write(message, values)
            return message.SerializeToString(deterministic=True)
        except (TypeError, ValueError, KeyError, EncodeError, json_format.Error) as error:
            raise BagError(f"the values do not match {name}: {error}") from error


def _reason(error: Exception) -> str:
    """Return the last part of an error of Google's parser, which repeats the type before."""
    return str(error).rpartition(": ")[2].rstrip(".")


_Read = Callable[[Any], dict[str, Any]]
_Write = Callable[[Any, Mapping[str, Any]], None]


class _Converter(Struct, frozen=True):
    """The conversions of one value of a field."""

    read: Callable[[Any], Any]
    write: Callable[[Any, Any], None] | None
    """Fills a message; None for values that are assigned."""


def _converter(field: FieldDescriptor) -> _Converter:
    match form_of(field):
        case Form.SCALAR:
            is_text = field.type == FieldDescriptor.TYPE_STRING
            return _Converter(_checked_text if is_text else lambda value: value, None)
        case Form.WRAPPER:
            return _Converter(lambda message: message.value, _fill_wrapper)
        case Form.JSON:
            return _Converter(json_text, _fill_json)
        case Form.MESSAGE:
            return _Converter(_reader(message_type(field)), _writer(message_type(field)))


def _fill_wrapper(message: Any, value: object) -> None:  # noqa: ANN401 - a protobuf message
    message.value = value
    message.SetInParent()


def _fill_json(message: Any, text: str) -> None:  # noqa: ANN401 - a protobuf message
    json_format.Parse(text, message, descriptor_pool=message.DESCRIPTOR.file.pool)
    message.SetInParent()


def json_text(message: Any) -> str:  # noqa: ANN401 - a protobuf message
    """Return a message as JSON text with the field names of its declaration."""
    return json_format.MessageToJson(
        message, preserving_proto_field_name=True, indent=None, descriptor_pool=message.DESCRIPTOR.file.pool
    )


def _is_map(field: FieldDescriptor) -> bool:
    return field.message_type is not None and field.message_type.GetOptions().map_entry


def _reader(descriptor: Descriptor) -> _Read:
    readers = [(field.name, _field_reader(field)) for field in descriptor.fields]
    return lambda message: {name: read(message) for name, read in readers}


def _field_reader(field: FieldDescriptor) -> Callable[[Any], Any]:
    name = field.name
    if _is_map(field):
        return _map_reader(name, message_type(field).fields_by_name["value"])
    read = _converter(field).read
    if field.is_repeated:
        return lambda message: [read(value) for value in getattr(message, name)]
    if field.has_presence:
        return lambda message: read(getattr(message, name)) if message.HasField(name) else None
    return lambda message: read(getattr(message, name))


def _checked_text(value: str | bytes) -> str:
    """Return a text; Google's parser returns the bytes of proto2 strings that are not UTF-8."""
    return value.decode() if isinstance(value, bytes) else value


def _map_reader(name: str, value: FieldDescriptor) -> Callable[[Any], Any]:
    read = _converter(value).read

    def entries(message: Any) -> list[dict[str, Any]]:  # noqa: ANN401 - a protobuf message
        return [{"key": key, "value": read(item)} for key, item in sorted(getattr(message, name).items())]

    return entries


def _writer(descriptor: Descriptor) -> _Write:
    writers = [(field.name, _field_writer(field)) for field in descriptor.fields]

    def write(message: Any, values: Mapping[str, Any]) -> None:  # noqa: ANN401 - a protobuf message
        for name, write_field in writers:
            value = values.get(name)
            if value is not None:
                write_field(message, value)

    return write


def _field_writer(field: FieldDescriptor) -> Callable[[Any, Any], None]:
    name = field.name
    if _is_map(field):
        return _map_writer(name, _converter(message_type(field).fields_by_name["value"]).write)
    fill = _converter(field).write
    if fill is None:
        if field.is_repeated:
            return lambda message, values: getattr(message, name).extend(values)
        return lambda message, value: setattr(message, name, value)
    if field.is_repeated:
        return lambda message, values: _fill_all(getattr(message, name), values, fill)
    return lambda message, value: _fill_one(getattr(message, name), value, fill)


def _fill_all(target: Any, values: list[Any], fill: Callable[[Any, Any], None]) -> None:  # noqa: ANN401 - a list of messages
    for value in values:
        fill(target.add(), value)


def _fill_one(target: Any, value: object, fill: Callable[[Any, Any], None]) -> None:  # noqa: ANN401 - a protobuf message
    target.SetInParent()
    fill(target, value)


def _map_writer(name: str, fill: Callable[[Any, Any], None] | None) -> Callable[[Any, Any], None]:
    def write(message: Any, entries: list[dict[str, Any]]) -> None:  # noqa: ANN401 - a protobuf message
        target = getattr(message, name)
        for entry in entries:
            if fill is None:
                target[entry["key"]] = entry["value"]
            else:
                fill(target[entry["key"]], entry["value"])

    return write
