"""This file reads a definition text of either language, `.msg` or IDL."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache

from mosaico_ingest.bag.definition import Container, Field, MessageType
from mosaico_ingest.bag.msgtext import SEPARATOR, Section, parse_msg, sections
from mosaico_ingest.bag.names import normalize_msgtype

__all__ = ["read_types"]

_MODULE = re.compile(r"^\s*module\s+\w+\s*\{", re.MULTILINE)
_DASHES = re.compile(r"^---[ \t\r]*$", re.MULTILINE)
_SERVICE_PARTS = re.compile(r"(.+/srv/.+)_(?:Event|Request|Response)")
_EVENT_INFO = "service_msgs/msg/ServiceEventInfo"


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
        from mosaico_ingest.bag.idl import read_idl  # noqa: PLC0415 - rosbags is slow to import, IDL rare

        return read_idl(section.text, where=f"{where or root}:{section.line + 1}")
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
