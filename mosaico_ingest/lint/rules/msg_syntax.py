"""The check of `msg-syntax`: a line of a `.msg` file that is not a declaration."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.errors import BagError
from mosaico_ingest.lint.check import Check, MessageFile, Problem
from mosaico_ingest.rosbag.definitions.model import parse_msg


def check(message: MessageFile) -> Iterator[Problem]:
    """Report each line that the definition parser rejects."""
    for span, line in message.lines():
        problem = _syntax_error(line, message.name)
        if problem is not None:
            yield Problem(problem, span, "write `type name`, `type NAME=value` or a comment")


def _syntax_error(line: str, name: str) -> str | None:
    try:
        parse_msg(line, name)
    except BagError as error:
        return error.what
    return None


CHECK = Check("msg-syntax", message=check)
