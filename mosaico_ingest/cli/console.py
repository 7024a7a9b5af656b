"""Terminal output: escaped lines, tables, JSON, findings with their source lines, and errors."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.padding import Padding
from rich.segment import Segment
from rich.style import StyleType
from rich.table import Table
from rich.text import Text

from mosaico_ingest.findings import Finding, Severity, Span, mask_credentials, one_line

FILE_WIDTH = 240
"""Columns of output that goes to a file or a pipe, where long lines do no harm."""
EXCERPT_WIDTH = 160
"""Columns of a source line below a finding."""
COLUMN_GAP = 2
"""Spaces between the columns of a table."""
INDENT = "  "
"""Start of the lines below the first cell of a row, if they have lines of their own."""
MAX_CELL_LINES = 3
"""Lines of a cell above which a table gets another layout."""
SEVERITY_STYLES = {Severity.ERROR: "bold red", Severity.WARNING: "bold yellow", Severity.INFO: "bold cyan"}

_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
_UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")
_LINE_END = re.compile(r"\r\n|\r|\n")
_SECRET = re.compile(
    r"((?:api_?key|password|token|secret)[\"']?\s*[:=]\s*[\"']?|(?=msco_))([^\s\"'$,}][^\s\"',}]*)",
    re.IGNORECASE,
)


class Terminal(Console):
    """A console that prints text literally: no markup, no emoji names, visible control characters."""

    def __init__(self, *, stderr: bool = False, soft_wrap: bool = False) -> None:
        stream = sys.stderr if stderr else sys.stdout
        # The stream is None if the process was started with it closed.
        width = None if stream is not None and stream.isatty() else FILE_WIDTH
        super().__init__(
            stderr=stderr, soft_wrap=soft_wrap, width=width, markup=False, emoji=False, highlight=False
        )

    def on_broken_pipe(self) -> None:
        """Discard further output if the reader is gone, so that the run and its exit code are unaffected."""
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), (sys.stderr if self.stderr else sys.stdout).fileno())

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Render as rich does, and replace the control characters of the text."""
        for segment in super().render(renderable, options):
            yield (
                segment
                if segment.control
                else Segment(_CONTROL.sub(_control_picture, segment.text), segment.style)
            )


class PlainTable(Table):
    """A table without borders that does not break words. Text cells are single lines, with control characters escaped.

    Columns in `numbers` are right-aligned and never wrapped. If the table is wider than the terminal, other columns wrap
    between words; if that is not enough, the first cell of a row has a line of its own, above the other cells; and at
    last, every cell has a line of its own. With `ellipsis`, long text is cut instead.
    """

    def __init__(
        self, *names: str, numbers: Collection[str] = (), ellipsis: bool = False, header: bool = True
    ) -> None:
        super().__init__(box=None, pad_edge=False, header_style="dim", show_header=header)
        self._names = names
        self._numbers = numbers
        self._ellipsis = ellipsis
        self._rows: list[list[Text]] = []
        for name in names:
            number = name in numbers
            self.add_column(
                name,
                justify="right" if number else "left",
                overflow="ellipsis" if ellipsis else "fold",
                no_wrap=number,
            )

    def add_row(
        self, *renderables: RenderableType | None, style: StyleType | None = None, end_section: bool = False
    ) -> None:
        """Add a row; a line break inside a name must not look like a line of our own."""
        cells = [Text(one_line(cell)) if isinstance(cell, str) else cell for cell in renderables]
        super().add_row(*cells, style=style, end_section=end_section)
        texts = [cell.copy() if isinstance(cell, Text) else Text() for cell in cells]
        for text in texts if style is not None else ():
            text.stylize_before(style or "")
        self._rows.append(texts)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render in the first layout that fits the width."""
        if not self._ellipsis and _table_width(self._natural_widths()) > options.max_width:
            widths = self._wrapped_widths(options.max_width)
            if widths is None:
                yield from self._stacked(console, options)
                return
            for column, width in zip(self.columns, widths, strict=True):
                column.width = width
        yield from super().__rich_console__(console, options)

    def _natural_widths(self) -> list[int]:
        headers = [cell_len(name) if self.show_header else 0 for name in self._names]
        return [
            max((header, *(row[column].cell_len for row in self._rows)))
            for column, header in enumerate(headers)
        ]

    def _wrapped_widths(self, width: int) -> list[int] | None:
        """Return widths of columns that wrap between words, or None if rows become narrow and high even so."""
        natural = self._natural_widths()
        widths = [
            full if name in self._numbers else self._longest_word(column)
            for column, (name, full) in enumerate(zip(self._names, natural, strict=True))
        ]
        spare = width - _table_width(widths)
        while spare > 0 and widths != natural:
            narrowest = max(range(len(widths)), key=lambda column: natural[column] / max(1, widths[column]))
            widths[narrowest] += 1
            spare -= 1
        fits = spare >= 0 and all(
            full <= MAX_CELL_LINES * least for full, least in zip(natural, widths, strict=True)
        )
        return widths if fits else None

    def _longest_word(self, column: int) -> int:
        texts = [self._names[column] if self.show_header else "", *(row[column].plain for row in self._rows)]
        return max((cell_len(word) for text in texts for word in text.split()), default=0)

    def _stacked(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the first cell of each row on a line of its own, and the other cells below it."""
        others = PlainTable(*self._names[1:], numbers=self._numbers, header=self.show_header)
        for column, source in zip(others.columns, self.columns[1:], strict=True):
            column.justify, column.style = source.justify, source.style
        for row in self._rows:
            others.add_row(*row[1:])
        indented = options.update(width=options.max_width - len(INDENT))
        lines: list[list[Segment]] = []
        if _table_width(others._natural_widths()) <= indented.max_width:
            lines = console.render_lines(others, indented, pad=False)
        if lines and self.show_header:
            yield from (Segment(INDENT), *lines.pop(0), Segment.line())
        for number, row in enumerate(self._rows):
            yield row[0]
            if lines:
                yield from (Segment(INDENT), *lines[number], Segment.line())
                continue
            pairs = (
                Text.assemble((f"{name}: ", "dim"), cell)
                for name, cell in zip(self._names[1:], row[1:], strict=True)
                if cell.plain
            )
            yield Padding(_packed(pairs, indented.max_width), (0, 0, 0, len(INDENT)), expand=False)


def _packed(parts: Iterable[Text], width: int) -> Text:
    """Return the parts in lines of at most `width` columns, broken between parts; a longer part has its own line."""
    lines: list[Text] = []
    for part in parts:
        if lines and lines[-1].cell_len + COLUMN_GAP + part.cell_len <= width:
            lines[-1] = Text("  ").join((lines[-1], part))
        else:
            lines.append(part)
    return Text("\n").join(lines)


def _table_width(widths: Sequence[int]) -> int:
    return sum(widths) + COLUMN_GAP * (len(widths) - 1)


def print_line(line: str, *, style: str = "", stderr: bool = False) -> None:
    """Print one line, escaping line breaks and control characters of names and reasons."""
    Terminal(stderr=stderr, soft_wrap=True).print(Text(one_line(line), style=style))


def print_json(value: object, *, default: Callable[[Any], object] = str) -> None:
    """Print a value as indented JSON; `default` converts members that JSON cannot represent."""
    sys.stdout.write(json.dumps(value, indent=2, ensure_ascii=False, default=default) + "\n")


def print_error(error: str, findings: Sequence[Finding]) -> None:
    """Print an error to standard error: its findings if it has any, otherwise its message."""
    console = Terminal(stderr=True, soft_wrap=True)
    if findings:
        console.print(render_findings(findings, read_sources(findings)))
    else:
        console.print(Text.assemble(("error: ", "bold red"), one_line(error)))


def read_sources(findings: Iterable[Finding]) -> dict[str, str]:
    """Return the text of the files that findings point into, by file name, without unreadable files."""
    sources: dict[str, str] = {}
    for file in {finding.span.file for finding in findings if finding.span is not None}:
        with suppress(OSError):
            sources[file] = Path(file).read_text(encoding="utf-8", errors="replace")
    return sources


def render_findings(findings: Iterable[Finding], sources: Mapping[str, str]) -> Text:
    """Return the findings with excerpts of `sources`, the texts of the files by name."""
    return Text("\n\n").join(_render_finding(finding, sources) for finding in findings)


def _render_finding(finding: Finding, sources: Mapping[str, str]) -> Text:
    style = SEVERITY_STYLES[finding.severity]
    text = Text()
    if finding.span is not None:
        text.append(one_line(f"{finding.span}: "), style="bold")
    text.append(f"{finding.severity.value}[{finding.rule}]", style=style)
    text.append(one_line(f" {mask_credentials(finding.message)}"))
    gutter = 0
    if finding.span is not None and finding.span.file in sources:
        gutter = len(str(finding.span.line))
        text.append(_excerpt(finding.span, sources[finding.span.file], style))
    if finding.help is not None:
        text.append(f"\n{' ' * gutter} = help: ", style="bold")
        text.append(one_line(mask_credentials(finding.help)))
    return text


def _excerpt(span: Span, source: str, style: str) -> Text:
    """Return the numbered source line with carets under the span, or nothing if the line is empty."""
    lines = _LINE_END.split(source.removeprefix("\ufeff"))
    if span.line > len(lines) or not lines[span.line - 1].strip():
        return Text()
    line = mask_credentials(lines[span.line - 1], same_length=True)
    line = _UNPRINTABLE.sub(" ", _SECRET.sub(_mask, line))
    start = min(span.column - 1, len(line))
    end = span.end_column - 1 if span.end_line == span.line else len(line)
    line, start, end = _crop(line, start, max(end, start + 1))
    margin = " " * len(str(span.line))
    text = Text(f"\n{margin} |\n{span.line} | {line}\n{margin} | ", style="")
    text.append(" " * cell_len(line[:start]))
    text.append("^" * max(1, cell_len(line[start:end])), style=style)
    return text


def _crop(line: str, start: int, end: int) -> tuple[str, int, int]:
    """Return the part of a long line that surrounds the span, and the span's columns in it."""
    if len(line) <= EXCERPT_WIDTH:
        return line, start, end
    offset = max(0, min(start - EXCERPT_WIDTH // 4, len(line) - EXCERPT_WIDTH))
    excerpt = line[offset : offset + EXCERPT_WIDTH]
    return excerpt, start - offset, min(end - offset, len(excerpt))


def _mask(match: re.Match[str]) -> str:
    return match[1] + "*" * len(match[2])


def _control_picture(match: re.Match[str]) -> str:
    code = ord(match[0])
    return chr(0x2400 + code) if code < 0x20 else "\ufffd"  # noqa: PLR2004 - Unicode has a picture of each C0 control
