"""The terminal: escaped output, findings with their source lines, and errors."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from mosaico_ingest.findings import Finding, Severity, Span, mask_credentials

__all__ = [
    "Terminal",
    "plain_table",
    "print_error",
    "print_line",
    "render_findings",
    "texts_of",
]

_CONTROLLING = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
_WIDE = 240
"""Columns of output that goes to a file or a pipe, where nothing needs to be folded."""


class Terminal(Console):
    """Prints text as it is: no markup, no emoji names, and a visible sign in place of each control character."""

    def __init__(self, *, stderr: bool = False, soft_wrap: bool = False) -> None:
        stream = sys.stderr if stderr else sys.stdout
        width = None if stream is not None and stream.isatty() else _WIDE  # None where it was closed
        super().__init__(
            stderr=stderr, soft_wrap=soft_wrap, width=width, markup=False, emoji=False, highlight=False
        )

    def on_broken_pipe(self) -> None:
        """Go on in silence where the reader has gone, as in `ingest job.yaml | head`: what is done, and its exit code, count."""
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), (sys.stderr if self.stderr else sys.stdout).fileno())

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Render as every console does, then take the controls out of the text."""
        for segment in super().render(renderable, options):
            yield (
                segment if segment.control else Segment(_CONTROLLING.sub(_sign, segment.text), segment.style)
            )


def plain_table(*names: str, numbers: Collection[str] = ()) -> Table:
    """Return a table without lines whose columns fold what is long, except those of `numbers`."""
    table = Table(box=None, pad_edge=False, header_style="dim")
    for name in names:
        number = name in numbers
        table.add_column(name, justify="right" if number else "left", overflow="fold", no_wrap=number)
    return table


def print_line(line: str, *, stderr: bool = False) -> None:
    """Print a line that may hold what a recording, a manifest or a file name says."""
    Terminal(stderr=stderr, soft_wrap=True).print(Text(line))


def _sign(match: re.Match[str]) -> str:
    code = ord(match[0])
    return chr(0x2400 + code) if code < 0x20 else "\ufffd"  # noqa: PLR2004 - Unicode has a picture of each C0 control


_STYLES = {Severity.ERROR: "bold red", Severity.WARNING: "bold yellow", Severity.INFO: "bold cyan"}
_SECRET = re.compile(
    r"((?:api_?key|password|token|secret)[\"']?\s*[:=]\s*[\"']?|(?=msco_))([^\s\"'$,}][^\s\"',}]*)",
    re.IGNORECASE,
)
_UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")
_LINE_END = re.compile(r"\r\n|\r|\n")
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
    text.append(f" {mask_credentials(finding.message)}")
    gutter = 0
    if finding.span is not None and finding.span.file in texts:
        gutter = len(str(finding.span.line))
        text.append(_excerpt(finding.span, texts[finding.span.file], _STYLES[finding.severity]))
    if finding.help is not None:
        text.append(f"\n{' ' * gutter} = help: ", style="bold")
        text.append(mask_credentials(finding.help))
    return text


def _excerpt(span: Span, source: str, style: str) -> Text:
    """Return the line with its number, and carets under the span; nothing where there is no such line."""
    lines = _LINE_END.split(source.removeprefix("\ufeff"))
    if span.line > len(lines) or not lines[span.line - 1].strip():
        return Text()
    line = _UNPRINTABLE.sub(" ", _SECRET.sub(_mask, mask_credentials(lines[span.line - 1], same_length=True)))
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


def print_error(error: str, findings: Sequence[Finding]) -> None:
    """Print to standard error."""
    console = Terminal(stderr=True, soft_wrap=True)
    if findings:
        console.print(render_findings(findings, texts_of(findings)))
    else:
        console.print(Text.assemble(("error: ", "bold red"), error))
