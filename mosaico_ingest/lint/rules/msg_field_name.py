"""The check of `msg-field-name`: a field name that ROS 2 rejects."""

from __future__ import annotations

import re
from collections.abc import Iterator

from mosaico_ingest.lint.check import Check, MessageFile, Problem

_NAME = re.compile(r"[a-z](_?[a-z0-9]+)*")


def check(message: MessageFile) -> Iterator[Problem]:
    """Report each field whose name is not in lower case with single underscores."""
    for declaration in message.declarations:
        if not declaration.is_constant and not _NAME.fullmatch(declaration.name):
            text = f"{declaration.name!r} is not a valid ROS 2 field name"
            yield Problem(text, declaration.name_span, "write it in the form snake_case")


CHECK = Check("msg-field-name", message=check)
