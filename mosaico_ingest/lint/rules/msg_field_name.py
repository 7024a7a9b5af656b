"""The rule `msg-field-name`: a field name that ROS 2 rejects."""

from __future__ import annotations

import re
from collections.abc import Iterator

from mosaico_ingest.lint.message import MessageFile
from mosaico_ingest.lint.rule import Check, Problem

_FIELD = re.compile(r"[a-z](_?[a-z0-9]+)*")


def check(message: MessageFile) -> Iterator[Problem]:
    """Yield a problem for each field whose name is not in that form."""
    for declaration in message.declarations:
        name = declaration.name
        if not declaration.constant and not _FIELD.fullmatch(name):
            yield Problem(f"{name!r} is no field name of ROS 2", declaration.name_span, "write_it_like_this")


CHECK = Check("msg-field-name", message=check)
