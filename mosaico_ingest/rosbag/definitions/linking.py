"""What is derived from a definition and those it refers to: links, Arrow shapes and hashes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from msgspec.structs import replace

from mosaico_ingest.errors import BagError, DecodeError
from mosaico_ingest.lazy import cache_by_identity
from mosaico_ingest.rosbag.definitions.model import (
    BYTES,
    HEADER,
    PRIMITIVES,
    Container,
    Definition,
    Field,
    MessageType,
    normalize_msgtype,
)

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_MAX_DEPTH = 64
_MAX_LEAVES = 20_000
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
"""The numpy type of every primitive except strings, in the payload and in the column."""
TEXTS = frozenset({"string", "wstring"})
_ANY = "*"
"""The MD5 sum that a ROS 1 subscriber writes to accept every form of a type."""


def link(
    root: MessageType, find: Callable[[str], MessageType | None], *, ros_version: int, hint: str
) -> dict[str, MessageType]:
    """Return `root` and all types that it refers to, by full name, with the full names of field types.

    `find` returns a type by full name. `hint` is the hint of the error for an unknown type.

    Raises:
        BagError: A type is unknown, not a ROS type, recursive, or too large.
    """
    linked = dict[str, MessageType]()
    waiting = [root]
    while waiting:
        message = waiting.pop()
        fields = list[Field]()
        for field in message.fields:
            if not field.is_message and field.type not in PRIMITIVES:
                raise BagError(f"{field.name} has the unsupported type {field.type}", where=message.name)
            needed = _needed(field, message.name, find, ros_version, hint) if field.is_message else None
            if needed and needed.name not in linked:
                waiting.append(needed)
            fields.append(replace(field, type=needed.name) if needed else field)
        linked[message.name] = replace(message, fields=tuple(fields))
    _leaves(root.name, linked, {}, depth=0)
    return linked


@cache_by_identity
def ros_shape(definition: Definition) -> pa.StructType:
    """Return the Arrow type of a message's rows. All fields are nullable; constants are not columns.

    Definitions in languages other than ROS have their own shape.

    Raises:
        DecodeError: A type is recursive, or a primitive is unknown.
    """
    return _struct(definition, definition.message, ()) if definition.shape is None else definition.shape


def rihs01(definition: Definition) -> str:
    """Return the ROS 2 hash of a type.

    Raises:
        BagError: rosbags cannot hash the type.
    """
    try:
        return _store(definition).hash_rihs01(definition.root)
    except KeyError as error:  # rosbags raises KeyError for wstring and for service events
        raise BagError(f"{definition.root} needs {error}, which has no hash") from error


def md5sum(definition: Definition) -> str:
    """Return the ROS 1 MD5 sum of a type.

    Raises:
        BagError: The type cannot be written in ROS 1.
    """
    return _store(definition).generate_msgdef(definition.root, ros_version=1)[1]


def definition_difference(definition: Definition, attributes: Mapping[str, str]) -> str | None:
    """Return how the hash of a definition differs from the recorded one; None if they are equal or unknown."""
    if definition.ros_version == 1:
        recorded, compute = attributes.get("md5sum", _ANY), md5sum
    else:
        recorded = attributes.get("type_description_hash") or attributes.get("topic_type_hash") or _ANY
        compute = rihs01
    try:
        computed = recorded if recorded == _ANY else compute(definition)
    except BagError:
        return None
    return None if computed == recorded else f"the recorded hash is {recorded}, the known one is {computed}"


def _needed(
    field: Field, owner: str, find: Callable[[str], MessageType | None], ros_version: int, hint: str
) -> MessageType:
    names = _candidate_names(field.type, owner, ros_version)
    message = next((message for name in names if (message := find(name))), None)
    if message is None:
        raise BagError(
            f"the definition of {names[-1]} is not known", where=f"{owner}.{field.name}", hint=hint
        )
    return message


def _candidate_names(name: str, owner: str, ros_version: int) -> list[str]:
    """Return the full names that `name` may mean in the text of `owner`, the most likely first."""
    namespace = owner.rpartition("/")[0]
    if "/" in name:
        package, _, short = name.rpartition("/")
        same_kind = f"{package}/{namespace.rpartition('/')[2]}/{short}"
        return list(dict.fromkeys((name, same_kind, normalize_msgtype(name))))
    if name == "Header" and ros_version == 1:
        return [HEADER]
    local = f"{namespace}/{name}" if namespace else name
    package = namespace.partition("/")[0]
    names = [local, f"{package}/msg/{name}"] if package else [local]
    return [*dict.fromkeys(names), HEADER] if name == "Header" else list(dict.fromkeys(names))


def _leaves(name: str, types: Mapping[str, MessageType], counts: dict[str, int], *, depth: int) -> int:
    """Return the number of columns of a type; a few lines of nested arrays could define millions of them."""
    if depth > _MAX_DEPTH or counts.get(name) == 0:
        reason = "contains itself" if counts.get(name) == 0 else f"is nested more than {_MAX_DEPTH} deep"
        raise BagError(f"{name} {reason}", where=name)
    if name not in counts:
        counts[name] = 0
        count = 1
        for field in types[name].fields:
            each = _leaves(field.type, types, counts, depth=depth + 1) if field.is_message else 1
            count += each * (field.size if field.container is Container.ARRAY and field.is_message else 1)
        if count > _MAX_LEAVES:
            raise BagError(f"{count} fields exceed the limit of {_MAX_LEAVES}", where=name)
        counts[name] = count
    return counts[name]


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


def _store(definition: Definition) -> Typestore:
    from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore  # noqa: PLC0415 - slow to import, and few recordings carry hashes and no definitions

    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_msg(definition.text, definition.root))
    except TypesysError as error:
        raise BagError(f"{definition.root} cannot be written: {error}") from error
    return store
