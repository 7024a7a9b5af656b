"""This file reads a definition text of either language, `.msg` or IDL, and rosbags' own form of types."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc, Typesdict
from rosbags.typesys import TypesysError, get_types_from_idl

from mosaico_ingest.bag.definition import Constant, Container, Field, MessageType
from mosaico_ingest.bag.msgtext import SEPARATOR, Section, parse_msg, sections
from mosaico_ingest.bag.names import normalize_msgtype
from mosaico_ingest.errors import BagError

__all__ = ["message_type", "read_types"]

_MODULE = re.compile(r"^\s*module\s+\w+\s*\{", re.MULTILINE)
_DASHES = re.compile(r"^---[ \t\r]*$", re.MULTILINE)
_SERVICE_PARTS = re.compile(r"(.+/srv/.+)_(?:Event|Request|Response)")
_NOT_CODE = re.compile(r"//[^\n]*|/\*.*?\*/|\"(?:\\.|[^\"\\])*\"", re.DOTALL)
_PLACEHOLDER = "structure_needs_at_least_one_member"
_EVENT_INFO = "service_msgs/msg/ServiceEventInfo"
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
"""What rosbags' IDL parser raises on text that is not IDL."""


@lru_cache(maxsize=4096)
def read_types(text: str, root: str, *, where: str | None = None) -> Mapping[str, MessageType]:
    """Return every type that `text` defines by full name; `root` names the part that has no name of its own.

    Field types keep the spelling of the text.

    Raises:
        BagError: A part cannot be read; names `where` (or the type) and the line.
    """
    types, parts = dict[str, MessageType](), list(sections(text))
    for part in parts:
        for message in _read_section(part, root, where):
            types.setdefault(message.name, message)
    if all(part.kind == "MSG" for part in parts) and not text.partition(SEPARATOR)[0].strip():
        types.setdefault(root, MessageType(root, ()))  # nothing before the other parts: it has no fields
    return types


def _read_section(section: Section, root: str, where: str | None) -> list[MessageType]:
    if section.kind == "IDL" or (not section.kind and _MODULE.search(section.text)):
        return _read_idl(section, where or root)
    name = normalize_msgtype(section.name) if section.name else root
    service, dashes = _SERVICE_PARTS.fullmatch(name), _DASHES.search(section.text)
    if service and dashes:
        return _read_service(service[1], section, dashes, where or root)
    return [parse_msg(section.text, name, where=where or root, line=section.line)]


def _read_service(name: str, section: Section, dashes: re.Match[str], where: str) -> list[MessageType]:
    """Return request, response and event of a service; recorders keep the `.srv` text for its events."""
    request, response = section.text[: dashes.start()], section.text[dashes.end() :]
    later = section.line + section.text.count("\n", 0, dashes.end())
    parts = [
        Field(part, f"{name}_{part.title()}", is_message=True, container=Container.SEQUENCE, size=1)
        for part in ("request", "response")
    ]
    return [
        parse_msg(request, parts[0].type, where=where, line=section.line),
        parse_msg(response, parts[1].type, where=where, line=later),
        MessageType(f"{name}_Event", (Field("info", _EVENT_INFO, is_message=True), *parts)),
    ]


def _read_idl(section: Section, where: str) -> list[MessageType]:
    if "<<" in _NOT_CODE.sub("", section.text):
        # No ROS message shifts, and one line of it could ask for all memory there is.
        raise BagError("shifts in IDL constants are not read", where=f"{where}:{section.line + 1}")
    try:
        types = get_types_from_idl(section.text)
    except _IDL_ERRORS as error:
        reason = " ".join(str(error).split())[-200:]
        raise BagError(f"cannot read the IDL: {reason}", where=f"{where}:{section.line + 1}") from None
    return [message_type(name, types) for name in types]


def message_type(name: str, types: Typesdict) -> MessageType:
    """Return one of rosbags' types in our form."""
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
