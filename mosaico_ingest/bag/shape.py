"""This file decides how a message type looks in Arrow; nowhere else is a field of a decoded row made."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from mosaico_ingest.bag.definition import Container, Definition, Field, MessageType
from mosaico_ingest.bag.msgtext import BYTES
from mosaico_ingest.errors import DecodeError

__all__ = ["NUMBERS", "TEXTS", "ros_shape"]

NUMBERS = {
    "bool": "?",
    "byte": "u1",
    "char": "u1",
    "uint8": "u1",
    "int8": "i1",
    "uint16": "u2",
    "int16": "i2",
    "uint32": "u4",
    "int32": "i4",
    "uint64": "u8",
    "int64": "i8",
    "float32": "f4",
    "float64": "f8",
}
"""The numpy type of every primitive but the texts, in the bytes and in the column."""

TEXTS = frozenset({"string", "wstring"})


def ros_shape(definition: Definition) -> pa.StructType:
    """Return the Arrow type of a message's rows; every field is nullable, constants are not columns.

    Raises:
        DecodeError: A type contains itself, or a primitive is unknown.
    """
    return _struct(definition, definition.message, ())


def _struct(definition: Definition, message: MessageType, within: tuple[str, ...]) -> pa.StructType:
    if message.name in within:
        raise DecodeError(f"type {message.name} contains itself", rule="definition", where=definition.root)
    within = (*within, message.name)
    return pa.struct([pa.field(field.name, _field(definition, field, within)) for field in message.fields])


def _field(definition: Definition, field: Field, within: tuple[str, ...]) -> pa.DataType:
    if field.container is Container.SEQUENCE and field.type in BYTES:
        return pa.binary()
    item = _item(definition, field, within)
    if field.container is Container.SCALAR:
        return item
    child = pa.field(field.name if pa.types.is_struct(item) else "item", item)
    return pa.list_(child, field.size) if field.container is Container.ARRAY else pa.list_(child)


def _item(definition: Definition, field: Field, within: tuple[str, ...]) -> pa.DataType:
    if field.is_message:
        return _struct(definition, definition.types[field.type], within)
    if field.type in TEXTS:
        return pa.string()
    if field.type not in NUMBERS:
        raise DecodeError(
            f"field {field.name} has the unknown type {field.type}", rule="definition", where=definition.root
        )
    return pa.from_numpy_dtype(np.dtype(NUMBERS[field.type]))
