"""The check of `msg-repeated-name`: two declarations with the same name."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.check import Check, MessageFile, Problem


def check(message: MessageFile) -> Iterator[Problem]:
    """Report each declaration whose name was declared before."""
    lines: dict[str, int] = {}
    for declaration in message.declarations:
        name, span = declaration.name, declaration.name_span
        if name in lines:
            yield Problem(
                f"{name!r} is already declared in line {lines[name]}", span, "rename one of the two"
            )
        lines.setdefault(name, span.line)


CHECK = Check("msg-repeated-name", message=check)
