"""This file joins a message type with every type it needs, and refuses what no message could be."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from mosaico_ingest.bag.definition import Container, Field, MessageType
from mosaico_ingest.bag.msgtext import PRIMITIVES
from mosaico_ingest.bag.names import HEADER, normalize_msgtype
from mosaico_ingest.errors import BagError

__all__ = ["link"]

_MAX_DEPTH = 64
_MAX_LEAVES = 20_000


def link(
    root: MessageType, find: Callable[[str], MessageType | None], *, ros_version: int, hint: str
) -> dict[str, MessageType]:
    """Return `root` and all it needs by full name, their fields' types spelled in full; `hint` says how to add one.

    Raises:
        BagError: A type is not known, is no ROS type, contains itself, or is too large to be one.
    """
    linked = dict[str, MessageType]()
    waiting = [root]
    while waiting:
        message = waiting.pop()
        fields = list[Field]()
        for field in message.fields:
            if not field.is_message and field.type not in PRIMITIVES:
                raise BagError(f"{field.name} is of type {field.type}, which is not read", where=message.name)
            needed = _needed(field, message.name, find, ros_version, hint) if field.is_message else None
            if needed and needed.name not in linked:
                waiting.append(needed)
            fields.append(replace(field, type=needed.name) if needed else field)
        linked[message.name] = replace(message, fields=tuple(fields))
    _leaves(root.name, linked, {}, depth=0)
    return linked


def _needed(
    field: Field, owner: str, find: Callable[[str], MessageType | None], ros_version: int, hint: str
) -> MessageType:
    names = _spellings(field.type, owner, ros_version)
    found = next((known for name in names if (known := find(name))), None)
    if found is None:
        raise BagError(
            f"the definition of {names[-1]} is not known", where=f"{owner}.{field.name}", hint=hint
        )
    return found


def _spellings(name: str, owner: str, ros_version: int) -> list[str]:
    """Return the full names that `name` may stand for in the text of `owner`, the likeliest first."""
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


def _leaves(name: str, types: Mapping[str, MessageType], known: dict[str, int], *, depth: int) -> int:
    """Count the columns of a type, to stop a few lines of text from becoming millions of them."""
    if depth > _MAX_DEPTH or known.get(name) == 0:
        reason = "contains itself" if known.get(name) == 0 else f"is nested more than {_MAX_DEPTH} deep"
        raise BagError(f"{name} {reason}", where=name)
    if name not in known:
        known[name] = 0
        count = 1
        for field in types[name].fields:
            each = _leaves(field.type, types, known, depth=depth + 1) if field.is_message else 1
            count += each * (field.size if field.container is Container.ARRAY and field.is_message else 1)
        if count > _MAX_LEAVES:
            raise BagError(f"{count} fields are more than a message can have", where=name)
        known[name] = count
    return known[name]
