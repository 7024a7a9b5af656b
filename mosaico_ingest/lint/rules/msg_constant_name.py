"""`msg-constant-name`: a constant name that ROS 2 refuses.

ROS 2 wants constants in capital letters, digits and single underscores.

Bad:
    uint8 statusOk=0

Good:
    uint8 STATUS_OK=0
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.message import MessageFile
from mosaico_ingest.lint.rule import Problem, Rule

_CONSTANT = re.compile(r"[A-Z](_?[A-Z0-9]+)*")


def check(message: MessageFile) -> Iterator[Problem]:
    """Yield a problem for each constant whose name is not in that form."""
    for declaration in message.declarations:
        name = declaration.name
        if declaration.constant and not _CONSTANT.fullmatch(name):
            yield Problem(
                f"{name!r} is no constant name of ROS 2", declaration.name_span, "WRITE_IT_LIKE_THIS"
            )


RULE = Rule("ING305", __name__, Severity.WARNING, __doc__, message=check)
