"""Parse IDL text with the parser of rosbags."""

from __future__ import annotations

import re

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc, Typesdict
from rosbags.typesys import TypesysError, get_types_from_idl

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.definitions.model import Constant, Container, Field, MessageType

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
