"""This file reads `# ingest: ignore[rule]` comments and takes out the findings they are about."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from mosaico_ingest.diagnostics import Finding, Severity, Span

__all__ = ["MARKER", "Ignore", "apply_ignores", "ignores_in"]

MARKER = "# ingest:"
"""What every comment to the linter starts with."""

_COMMENT = re.compile(r"#\s*ingest:\s*(ignore|ignore-file)\s*\[([^\]]*)\]")
_WORD = re.compile(r"[^\s,]+")


@dataclass(slots=True)
class Ignore:
    """One rule that a comment silences, on its line (alone on a line: on the next) or in the whole file."""

    rule: str
    """As written: a code or a name."""
    span: Span
    lines: range
    used: bool = field(default=False)


def ignores_in(text: str, *, file: str) -> list[Ignore]:
    """Return what the comments of a text silence."""
    ignores: list[Ignore] = []
    for number, line in enumerate(text.splitlines(), 1):
        for comment in _COMMENT.finditer(line):
            alone = not line[: comment.start()].strip()
            lines = range(number + alone, number + alone + 1)
            if comment[1] == "ignore-file":
                lines = range(1, text.count("\n") + 2)
            for word in _WORD.finditer(comment[2]):
                start = comment.start(2) + word.start() + 1
                ignores.append(
                    Ignore(word[0], Span(file, number, start, number, start + len(word[0])), lines)
                )
    return ignores


def apply_ignores(
    findings: Iterable[Finding], ignores: Sequence[Ignore], names: dict[str, str]
) -> list[Finding]:
    """Return the findings that no comment silences, and one for each comment that silences nothing.

    `names` maps every code and every name of a rule to its name.
    """
    kept = [finding for finding in findings if not _silenced(finding, ignores, names)]
    kept += [_complaint(ignore, names) for ignore in ignores if not ignore.used]
    return kept


def _silenced(finding: Finding, ignores: Sequence[Ignore], names: dict[str, str]) -> bool:
    line = finding.span.line if finding.span else 0
    about = [item for item in ignores if names.get(item.rule) == finding.rule and line in item.lines]
    for ignore in about:
        ignore.used = True
    return bool(about)


def _complaint(ignore: Ignore, names: dict[str, str]) -> Finding:
    if ignore.rule in names:
        message = f"nothing here breaks {ignore.rule}"
        return Finding("unused-ignore", Severity.WARNING, message, ignore.span, "remove it from the comment")
    message = f"there is no rule {ignore.rule!r}"
    return Finding("unknown-rule", Severity.WARNING, message, ignore.span, "see `ingest lint --explain all`")
