"""Comments that suppress findings: `# ingest: ignore[RULE]` for a line, `# ingest: ignore-file[RULE]` for a file."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches

from mosaico_ingest.findings import Finding, Severity, Span
from mosaico_ingest.rules import LINT_RULES, find_rule

_COMMENT = re.compile(r"#\s*ingest:\s*(?P<action>[\w-]+)(?:\s*\[(?P<rules>[^\]\n]*)\]?)?")
_ACTIONS = ("ignore", "ignore-file")
_WORD = re.compile(r"[^\s,]+")
_REMEDY = "name a rule in brackets, such as `# ingest: ignore[yaml-boolean]`"


@dataclass(slots=True)
class Ignore:
    """One rule that a comment suppresses, or a comment that names no rule."""

    rule: str
    """The id or code as written; empty if the comment names no rule."""
    span: Span
    lines: range
    """The affected lines: the line of the comment, the next line if the comment stands alone, or the entire file."""
    used: bool = field(default=False)


def ignores_in(text: str, *, file: str) -> list[Ignore]:
    """Return the rules that the comments of a text suppress."""
    lines = text.splitlines()
    return [
        ignore
        for number, line in enumerate(lines, 1)
        for comment in _COMMENT.finditer(line)
        for ignore in _ignores(comment, Span(file, number, 1, number, 1), range(1, len(lines) + 2))
    ]


def apply_ignores(findings: Iterable[Finding], ignores: Sequence[Ignore]) -> list[Finding]:
    """Return the findings that no comment suppresses, and a finding for each comment that suppresses nothing."""
    remaining = [finding for finding in findings if not _is_suppressed(finding, ignores)]
    return remaining + [_useless(ignore) for ignore in ignores if not ignore.used]


def _ignores(comment: re.Match[str], line: Span, file_lines: range) -> Iterable[Ignore]:
    action = comment["action"]
    if action not in _ACTIONS and not get_close_matches(action, _ACTIONS, n=1, cutoff=0.7):
        return
    stands_alone = not comment.string[: comment.start()].strip()
    first = line.line + stands_alone
    lines = file_lines if action == "ignore-file" else range(first, first + 1)
    words = list(_WORD.finditer(comment["rules"] or "")) if action in _ACTIONS else []
    for word in words:
        start = comment.start("rules") + word.start() + 1
        yield Ignore(word[0], Span(line.file, line.line, start, line.line, start + len(word[0])), lines)
    if not words:
        span = Span(line.file, line.line, comment.start() + 1, line.line, comment.end() + 1)
        yield Ignore("", span, lines)


def _is_suppressed(finding: Finding, ignores: Sequence[Ignore]) -> bool:
    line = finding.span.line if finding.span else 0
    matches = [item for item in ignores if line in item.lines and _lint_rule(item.rule) == finding.rule]
    for ignore in matches:
        ignore.used = True
    return bool(matches)


def _lint_rule(name: str) -> str | None:
    rule = find_rule(name)
    return rule.id if rule is not None and rule.is_lint else None


def _useless(ignore: Ignore) -> Finding:
    if _lint_rule(ignore.rule) is not None:
        message = f"{ignore.rule} reports nothing here"
        return Finding("unused-ignore", Severity.WARNING, message, ignore.span, "remove it from the comment")
    if not ignore.rule:
        message = "the comment suppresses nothing, because it names no rule"
        return Finding("unknown-rule", Severity.WARNING, message, ignore.span, _REMEDY)
    if find_rule(ignore.rule) is not None:
        message = f"{ignore.rule} is reported by plan or run, which ignore comments do not affect"
        return Finding("unknown-rule", Severity.WARNING, message, ignore.span, "remove it from the comment")
    close = get_close_matches(ignore.rule, LINT_RULES, n=1)
    hint = f"did you mean {close[0]!r}?" if close else "see `ingest lint --explain all`"
    return Finding("unknown-rule", Severity.WARNING, f"there is no rule {ignore.rule!r}", ignore.span, hint)
