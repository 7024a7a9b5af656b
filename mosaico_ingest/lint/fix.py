"""This file makes the changes that findings propose, all at once, leaving the rest of a text as it is."""

from __future__ import annotations

from collections.abc import Iterable

from mosaico_ingest.diagnostics import Edit, Finding

__all__ = ["apply_fixes"]


def apply_fixes(text: str, findings: Iterable[Finding]) -> tuple[str, int]:
    """Return the text with every proposed change that does not touch another one, and how many those are."""
    lines = text.splitlines(keepends=True)
    edits = sorted(
        {finding.fix for finding in findings if finding.fix is not None}, key=lambda edit: edit.span
    )
    made = 0
    untouched = (len(lines) + 1, 0)
    for edit in reversed(edits):
        span = edit.span
        if (span.end_line, span.end_column) <= untouched and span.line == span.end_line <= len(lines):
            lines[span.line - 1] = _edited(lines[span.line - 1], edit)
            untouched = (span.line, span.column)
            made += 1
    return "".join(lines), made


def _edited(line: str, edit: Edit) -> str:
    return line[: edit.span.column - 1] + edit.text + line[edit.span.end_column - 1 :]
