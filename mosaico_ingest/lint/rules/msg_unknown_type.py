"""The rule `msg-unknown-type`: a field whose type is not defined."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.message import MessageFile, is_known
from mosaico_ingest.lint.rule import Check, Problem
from mosaico_ingest.rosbag.definitions.parser import PRIMITIVES


def check(message: MessageFile) -> Iterator[Problem]:
    """Yield a problem for each type that cannot be found."""
    for declaration in message.declarations:
        kind = declaration.type
        if declaration.constant or kind in PRIMITIVES or kind in _SPECIAL or is_known(kind, message.path):
            continue
        remedy = "put its .msg file beside this one" if "/" not in kind else "define it under bag.custom_msgs"
        yield Problem(f"there is no type {kind!r}", declaration.type_span, remedy)


_SPECIAL = {"time", "duration", "Header"}


CHECK = Check("msg-unknown-type", message=check)
