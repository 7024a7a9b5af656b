"""The rule `msg-syntax`: a line of a `.msg` file that is not a declaration."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.errors import BagError
from mosaico_ingest.lint.message import MessageFile
from mosaico_ingest.lint.rule import Check, Problem
from mosaico_ingest.rosbag.definitions.parser import parse_msg


def check(message: MessageFile) -> Iterator[Problem]:
    """Yield a problem for each line the parser of definitions refuses."""
    for span, line in message.lines():
        fault = _fault(line, message.name)
        if fault is not None:
            yield Problem(fault, span, "a line is `type name`, `type NAME=value` or a comment")


def _fault(line: str, name: str) -> str | None:
    try:
        parse_msg(line, name)
    except BagError as error:
        return error.what
    return None


CHECK = Check("msg-syntax", message=check)
