"""The check of `msg-unknown-type`: a field whose type is not defined."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.check import Check, MessageFile, Problem, is_defined
from mosaico_ingest.rosbag.definitions.model import PRIMITIVES
from mosaico_ingest.rosbag.definitions.registry import suggest_type

_SPECIAL_TYPES = frozenset({"time", "duration", "Header"})


def check(message: MessageFile) -> Iterator[Problem]:
    """Report each field whose type is not defined."""
    for declaration in message.declarations:
        msgtype = declaration.type
        if declaration.is_constant or msgtype in PRIMITIVES or msgtype in _SPECIAL_TYPES:
            continue
        if not is_defined(msgtype, message.path):
            yield Problem(
                f"the type {msgtype!r} is not defined", declaration.type_span, suggest_type(msgtype)
            )


CHECK = Check("msg-unknown-type", message=check)
