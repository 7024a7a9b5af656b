"""The rule `msg-constant-name`: a constant name that ROS 2 rejects."""

from __future__ import annotations

import re
from collections.abc import Iterator

from mosaico_ingest.lint.message import MessageFile
from mosaico_ingest.lint.rule import Check, Problem

_CONSTANT = re.compile(r"[A-Z](_?[A-Z0-9]+)*")


def check(message: MessageFile) -> Iterator[Problem]:
    """Yield a problem for each constant whose name is not in that form."""
    for declaration in message.declarations:
        name = declaration.name
        if declaration.constant and not _CONSTANT.fullmatch(name):
            yield Problem(
                f"{name!r} is no constant name of ROS 2", declaration.name_span, "WRITE_IT_LIKE_THIS"
            )


CHECK = Check("msg-constant-name", message=check)
