"""This file draws findings for a person: the place, the message, the line with a caret, the remedy."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

from rich.cells import cell_len
from rich.text import Text

from mosaico_ingest.diagnostics import Finding, Severity, Span

__all__ = ["render_findings", "texts_of"]

_STYLES = {Severity.ERROR: "bold red", Severity.WARNING: "bold yellow", Severity.INFO: "bold cyan"}
_SECRET = re.compile(
    r"((?:api_?key|password|token|secret)[\"']?\s*[:=]\s*[\"']?|(?=msco_))([^\s\"'$,}][^\s\"',}]*)",
    re.IGNORECASE,
)
_UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")
_WIDTH = 160


def render_findings(findings: Iterable[Finding], texts: Mapping[str, str]) -> Text:
    """Return the findings with their source lines; `texts` holds what is known of the files, by name."""
    return Text("\n\n").join(_finding(finding, texts) for finding in findings)


def texts_of(findings: Iterable[Finding]) -> dict[str, str]:
    """Read the files that findings point into; what cannot be read is left out."""
    texts: dict[str, str] = {}
    for file in {finding.span.file for finding in findings if finding.span is not None}:
        with suppress(OSError):
            texts[file] = Path(file).read_text(encoding="utf-8", errors="replace")
    return texts


def _finding(finding: Finding, texts: Mapping[str, str]) -> Text:
    text = Text()
    if finding.span is not None:
        text.append(f"{finding.span}: ", style="bold")
    text.append(f"{finding.severity.value}[{finding.rule}]", style=_STYLES[finding.severity])
    text.append(f" {finding.message}")
    gutter = 0
    if finding.span is not None and finding.span.file in texts:
        gutter = len(str(finding.span.line))
        text.append(_excerpt(finding.span, texts[finding.span.file], _STYLES[finding.severity]))
    if finding.help is not None:
        text.append(f"\n{' ' * gutter} = help: ", style="bold")
        text.append(finding.help)
    return text


def _excerpt(span: Span, source: str, style: str) -> Text:
    """Return the line with its number, and carets under the span; nothing where there is no such line."""
    lines = source.removeprefix("\ufeff").split("\n")
    if span.line > len(lines) or not lines[span.line - 1].strip():
        return Text()
    line = _UNPRINTABLE.sub(" ", _SECRET.sub(_mask, lines[span.line - 1].rstrip("\r")))
    start = min(span.column - 1, len(line))
    end = span.end_column - 1 if span.end_line == span.line else len(line)
    line, start, end = _crop(line, start, max(end, start + 1))
    margin = " " * len(str(span.line))
    text = Text(f"\n{margin} |\n{span.line} | {line}\n{margin} | ", style="")
    text.append(" " * cell_len(line[:start]))
    text.append("^" * max(1, cell_len(line[start:end])), style=style)
    return text


def _crop(line: str, start: int, end: int) -> tuple[str, int, int]:
    """Cut a long line down to what surrounds the span."""
    if len(line) <= _WIDTH:
        return line, start, end
    left = max(0, min(start - _WIDTH // 4, len(line) - _WIDTH))
    shown = line[left : left + _WIDTH]
    return shown, start - left, min(end - left, len(shown))


def _mask(match: re.Match[str]) -> str:
    return match[1] + "*" * len(match[2])
