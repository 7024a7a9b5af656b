"""The check of `msg-constant-name`: a constant name that ROS 2 rejects."""

from __future__ import annotations

import re
from collections.abc import Iterator

from mosaico_ingest.lint.check import Check, MessageFile, Problem

_NAME = re.compile(r"[A-Z](_?[A-Z0-9]+)*")


def check(message: MessageFile) -> Iterator[Problem]:
    """Report each constant whose name is not in upper case with single underscores."""
    for declaration in message.declarations:
        if declaration.is_constant and not _NAME.fullmatch(declaration.name):
            text = f"{declaration.name!r} is not a valid ROS 2 constant name"
            yield Problem(text, declaration.name_span, "write it in the form UPPER_CASE")


CHECK = Check("msg-constant-name", message=check)
