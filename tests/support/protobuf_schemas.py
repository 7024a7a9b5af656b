"""Protobuf schemas with every feature of the language, and their messages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from google.protobuf import descriptor_pool, message_factory, struct_pb2, timestamp_pb2, wrappers_pb2
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FeatureSet,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)

from mosaico_ingest.rosbag.definitions.model import Definition, Embedded
from mosaico_ingest.rosbag.encodings.protobuf import read_schema

F = FieldDescriptorProto
SCALARS = {
    name: getattr(F, f"TYPE_{name.upper()}")
    for name in (
        "double", "float", "int32", "int64", "uint32", "uint64", "sint32", "sint64",
        "fixed32", "fixed64", "sfixed32", "sfixed64", "bool", "string", "bytes",
    )
}  # fmt: skip


def _field(message: DescriptorProto, name: str, kind: int | str, **options: Any) -> FieldDescriptorProto:
    number = options.pop("number", len(message.field) + 1)
    field = message.field.add(name=name, number=number, label=options.pop("label", F.LABEL_OPTIONAL))
    if isinstance(kind, str):
        field.type = options.pop("type", F.TYPE_MESSAGE)
        field.type_name = kind
    else:
        field.type = kind
    if options.pop("optional", False):
        field.proto3_optional = True
        field.oneof_index = len(message.oneof_decl)
        message.oneof_decl.add(name=f"_{name}")
    for key, value in options.items():
        setattr(field, key, value)
    return field


def _map(message: DescriptorProto, name: str, key: int, value: int | str) -> None:
    entry = message.nested_type.add(name=f"{name.title()}Entry")
    entry.options.map_entry = True
    _field(entry, "key", key)
    _field(entry, "value", value)
    _field(message, name, f".all.{message.name}.{entry.name}", label=F.LABEL_REPEATED)


def proto3_file() -> FileDescriptorProto:
    """Return a file whose message `all.Message` uses every feature of proto3."""
    file = FileDescriptorProto(name="all3.proto", package="all", syntax="proto3")
    file.dependency.extend(
        ["google/protobuf/timestamp.proto", "google/protobuf/wrappers.proto", "google/protobuf/struct.proto"]
    )
    color = file.enum_type.add(name="Color")
    for number, name in enumerate(("RED", "GREEN", "BLUE")):
        color.value.add(name=name, number=number)
    inner = file.message_type.add(name="Inner")
    _field(inner, "x", F.TYPE_DOUBLE)
    _field(inner, "label", F.TYPE_STRING)
    tree = file.message_type.add(name="Tree")
    _field(tree, "value", F.TYPE_INT32)
    _field(tree, "children", ".all.Tree", label=F.LABEL_REPEATED)
    file.message_type.add(name="Empty")
    message = file.message_type.add(name="Message")
    message.oneof_decl.add(name="choice")
    # The first fields have high numbers, so that the order of the declaration is not that of the numbers.
    _field(message, "last", F.TYPE_INT32, number=200)
    for name, kind in SCALARS.items():
        _field(message, f"one_{name}", kind, number=len(message.field) + 1)
        _field(message, f"maybe_{name}", kind, number=len(message.field) + 1, optional=True)
        _field(message, f"many_{name}", kind, number=len(message.field) + 1, label=F.LABEL_REPEATED)
    for name, options in (("one", {}), ("maybe", {"optional": True}), ("many", {"label": F.LABEL_REPEATED})):
        _field(message, f"{name}_color", ".all.Color", type=F.TYPE_ENUM, **options)
    _field(message, "inner", ".all.Inner")
    _field(message, "inners", ".all.Inner", label=F.LABEL_REPEATED)
    _field(message, "stamp", ".google.protobuf.Timestamp")
    _field(message, "wrapped", ".google.protobuf.DoubleValue")
    _field(message, "wrapped_texts", ".google.protobuf.StringValue", label=F.LABEL_REPEATED)
    _field(message, "free", ".google.protobuf.Struct")
    _field(message, "tree", ".all.Tree")
    _field(message, "nothing", ".all.Empty")
    for name, kind in (
        ("text_choice", F.TYPE_STRING),
        ("int_choice", F.TYPE_INT32),
        ("inner_choice", ".all.Inner"),
    ):
        _field(message, name, kind, oneof_index=0)
    unpacked = _field(message, "unpacked", F.TYPE_INT32, label=F.LABEL_REPEATED)
    unpacked.options.packed = False
    _map(message, "numbers", F.TYPE_STRING, F.TYPE_INT32)
    _map(message, "messages", F.TYPE_INT32, ".all.Inner")
    return file


def proto2_file(*, group: bool = False) -> FileDescriptorProto:
    """Return a file whose message `all.Old` uses the features that only proto2 has."""
    file = FileDescriptorProto(name="all2.proto", package="all", syntax="proto2")
    color = file.enum_type.add(name="Level")
    for number, name in ((3, "LOW"), (7, "HIGH")):
        color.value.add(name=name, number=number)
    old = file.message_type.add(name="Old")
    _field(old, "needed", F.TYPE_INT32, label=F.LABEL_REQUIRED)
    _field(old, "text", F.TYPE_STRING, default_value="nothing")
    _field(old, "level", ".all.Level", type=F.TYPE_ENUM, default_value="HIGH")
    _field(old, "levels", ".all.Level", type=F.TYPE_ENUM, label=F.LABEL_REPEATED)
    _field(old, "values", F.TYPE_DOUBLE, label=F.LABEL_REPEATED)
    if group:
        part = old.nested_type.add(name="Part")
        _field(part, "size", F.TYPE_INT32)
        _field(old, "part", ".all.Old.Part", type=F.TYPE_GROUP, label=F.LABEL_REPEATED)
    return file


def editions_file(*, delimited: bool = False) -> FileDescriptorProto:
    """Return a file of edition 2023; its message `all.New` sets the features that affect decoding."""
    file = FileDescriptorProto(name="new.proto", package="all", syntax="editions", edition="EDITION_2023")
    for name, kind in (("Open", FeatureSet.OPEN), ("Closed", FeatureSet.CLOSED)):
        enum = file.enum_type.add(name=name)
        enum.options.features.enum_type = kind
        for number in range(2):
            enum.value.add(name=f"{name.upper()}_{number}", number=number)
    inner = file.message_type.add(name="Inner")
    _field(inner, "x", F.TYPE_DOUBLE)
    message = file.message_type.add(name="New")
    _field(message, "explicit", F.TYPE_INT32)
    implicit = _field(message, "implicit", F.TYPE_INT32)
    implicit.options.features.field_presence = FeatureSet.IMPLICIT
    required = _field(message, "required", F.TYPE_INT32)
    required.options.features.field_presence = FeatureSet.LEGACY_REQUIRED
    unverified = _field(message, "unverified", F.TYPE_STRING)
    unverified.options.features.utf8_validation = FeatureSet.NONE
    expanded = _field(message, "expanded", F.TYPE_INT32, label=F.LABEL_REPEATED)
    expanded.options.features.repeated_field_encoding = FeatureSet.EXPANDED
    _field(message, "packed", F.TYPE_INT32, label=F.LABEL_REPEATED)
    _field(message, "open", ".all.Open", type=F.TYPE_ENUM)
    _field(message, "closed", ".all.Closed", type=F.TYPE_ENUM)
    _field(message, "closed_list", ".all.Closed", type=F.TYPE_ENUM, label=F.LABEL_REPEATED)
    nested = _field(message, "inner", ".all.Inner")
    if delimited:
        nested.options.features.message_encoding = FeatureSet.DELIMITED
    return file


def file_set(file: FileDescriptorProto) -> bytes:
    """Return the file with its dependencies as a serialized FileDescriptorSet."""
    files = FileDescriptorSet()
    for module in (timestamp_pb2, wrappers_pb2, struct_pb2):
        if module.DESCRIPTOR.name in file.dependency:
            module.DESCRIPTOR.CopyToProto(files.file.add())
    files.file.append(file)
    return files.SerializeToString()


def definition_of(file: FileDescriptorProto, name: str) -> Definition:
    """Return the definition of a message type of a file."""
    return read_schema(name, Embedded.from_bytes("protobuf", file_set(file)))


def message_class(file: FileDescriptorProto, name: str) -> type[Any]:
    """Return the class of the messages of a type of a file."""
    pool = descriptor_pool.DescriptorPool()
    for one in FileDescriptorSet.FromString(file_set(file)).file:
        pool.Add(one)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


FieldValues = Mapping[str, Any]
