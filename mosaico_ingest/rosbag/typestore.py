"""The typestores of the rosbags library: their definitions as text, and their message objects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from rosbags.interfaces import Nodetype

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded, normalize_msgtype
from mosaico_ingest.rosbag.definitions.registry import TypeResolver

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_HEADER = "std_msgs/msg/Header"


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
    from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore  # noqa: PLC0415 - slow to import, and only exports of adapters in Python need it

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
