"""`msg-repeated-name`: two declarations of one name.

A field could not be told from the other one.

Bad:
    float64 voltage
    float32 voltage

Good:
    float64 voltage
    float32 current
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.message import MessageFile
from mosaico_ingest.lint.rule import Problem, Rule


def check(message: MessageFile) -> Iterator[Problem]:
    """Yield a problem for each name that was declared before."""
    lines: dict[str, int] = {}
    for declaration in message.declarations:
        name, span = declaration.name, declaration.name_span
        if name in lines:
            yield Problem(
                f"{name!r} is already declared in line {lines[name]}", span, "rename one of the two"
            )
        lines.setdefault(name, span.line)


RULE = Rule("ING303", __name__, Severity.ERROR, __doc__, message=check)
