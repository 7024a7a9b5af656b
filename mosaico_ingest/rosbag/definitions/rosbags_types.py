"""Types of the rosbags library: IDL text that it parses, and its typestores with their definitions and message objects."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc, Typesdict
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.definitions.model import (
    Constant,
    Container,
    Definition,
    Embedded,
    Field,
    MessageType,
    normalize_msgtype,
)
from mosaico_ingest.rosbag.definitions.registry import TypeResolver

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_NOT_CODE = re.compile(r"//[^\n]*|/\*.*?\*/|\"(?:\\.|[^\"\\])*\"", re.DOTALL)
_PLACEHOLDER = "structure_needs_at_least_one_member"
_CONTAINERS = {Nodetype.ARRAY: Container.ARRAY, Nodetype.SEQUENCE: Container.SEQUENCE}
_IDL_ERRORS = (
    TypesysError,
    AssertionError,
    LookupError,
    TypeError,
    ValueError,
    ArithmeticError,
    RecursionError,
)
"""Exceptions that the parser of rosbags raises for invalid IDL."""
_HEADER = "std_msgs/msg/Header"


def read_idl(text: str, *, where: str) -> list[MessageType]:
    """Return every type that `text` defines; `where` is its location in error messages.

    Raises:
        BagError: The text is not valid IDL.
    """
    if "<<" in _NOT_CODE.sub("", text):
        # No ROS message uses shifts, and one line with a large shift could exhaust the memory.
        raise BagError("shifts in IDL constants are not supported", where=where)
    try:
        types = get_types_from_idl(text)
    except _IDL_ERRORS as error:
        reason = " ".join(str(error).split())[-200:]
        raise BagError(f"cannot parse the IDL: {reason}", where=where) from None
    return [message_type(name, types) for name in types]


def message_type(name: str, types: Typesdict) -> MessageType:
    """Convert a type of rosbags."""
    constants, fields = types[name]
    return MessageType(
        name,
        tuple(_field(field, desc) for field, desc in fields if field != _PLACEHOLDER),
        tuple(Constant(constant, kind, value) for constant, kind, value in constants),
    )


def definition_texts(typestore: Typestore) -> dict[str, str]:
    """Return the definition of each type of a typestore, with its dependencies."""
    version = _ros_version(typestore)
    return {name: typestore.generate_msgdef(name, ros_version=version)[0] for name in typestore.fielddefs}


def definition_in(typestore: Typestore, msgtype: str) -> Definition:
    """Return the parsed definition of a type of a typestore.

    Raises:
        BagError: The typestore does not have the type.
    """
    name, version = normalize_msgtype(msgtype), _ros_version(typestore)
    if name not in typestore.fielddefs:
        raise BagError(f"the typestore does not define {name}", hint="register the type in the typestore")
    text, _ = typestore.generate_msgdef(name, ros_version=version)
    return TypeResolver("empty").resolve(name, Embedded(f"ros{version}msg", text), ros_version=version)


def typestore_of(definition: Definition) -> Typestore:
    """Return a typestore with the types of one definition.

    Raises:
        BagError: rosbags cannot parse the definition.
    """
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_msg(definition.text, definition.root))
    except (TypesysError, KeyError) as error:
        raise BagError(f"rosbags cannot parse the definition: {error}", where=definition.root) from error
    return store


def message_values(message: Any, shape: pa.StructType) -> dict[str, Any]:  # noqa: ANN401 - a generated class, or a dict
    """Return the fields of a message object, or of a dictionary with the same fields, for an array in the ROS shape.

    Raises:
        AttributeError, KeyError: The message lacks a field.
    """
    values: Mapping[str, Any] | None = message if isinstance(message, Mapping) else None
    return {
        field.name: _plain(
            values[field.name] if values is not None else getattr(message, field.name), field.type
        )
        for field in shape
    }


def native_message(typestore: Typestore, msgtype: str, values: Mapping[str, Any]) -> Any:  # noqa: ANN401 - a generated class
    """Return the message object of a typestore with the field values of a dictionary."""
    fields: dict[str, Any] = {}
    for name, (kind, detail) in typestore.fielddefs[msgtype][1]:
        value: Any = values[name]
        if kind is Nodetype.NAME:
            value = native_message(typestore, str(detail), value)
        elif kind in {Nodetype.ARRAY, Nodetype.SEQUENCE}:
            value = _native_list(typestore, detail[0], value)
        fields[name] = value
    return typestore.types[msgtype](**fields)


def _field(name: str, desc: FieldDesc) -> Field:
    if desc[0] == Nodetype.BASE:
        return Field(name, desc[1][0], string_bound=desc[1][1])
    if desc[0] == Nodetype.NAME:
        return Field(name, desc[1], is_message=True)
    element, size = desc[1]
    plain = _field(name, element)
    return Field(
        name,
        plain.type,
        plain.is_message,
        _CONTAINERS[Nodetype(desc[0])],
        size,
        string_bound=plain.string_bound,
    )


def _plain(value: Any, kind: Any) -> Any:  # noqa: ANN401 - any field value and its type
    if pa.types.is_struct(kind):
        return message_values(value, kind)
    if pa.types.is_binary(kind) or pa.types.is_fixed_size_binary(kind):
        return bytes(value)
    if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        if isinstance(value, np.ndarray):
            return value.tolist()
        return [_plain(item, kind.value_type) for item in value]
    return value


def _native_list(typestore: Typestore, element: Any, values: Any) -> Any:  # noqa: ANN401 - rosbags' nested tuples
    """Return numbers as an array, other elements as a list."""
    kind, detail = element
    if kind is Nodetype.NAME:
        return [native_message(typestore, str(detail), value) for value in values]
    if detail[0] in {"string", "wstring"}:
        return list(values)
    dtype = {"octet": "uint8", "byte": "uint8", "char": "uint8"}.get(detail[0], detail[0])
    return np.frombuffer(values, dtype) if isinstance(values, bytes) else np.array(values, dtype)


def _ros_version(typestore: Typestore) -> int:
    """Return 1 if the header of a typestore has a sequence number, else 2."""
    fields = typestore.fielddefs[_HEADER][1] if _HEADER in typestore.fielddefs else ()
    return 1 if any(name == "seq" for name, _ in fields) else 2
