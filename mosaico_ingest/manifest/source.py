"""This file reads YAML text and keeps the position of every value, so that each finding can point at it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import field

import yaml

from mosaico_ingest.diagnostics import Finding, Severity, Span
from mosaico_ingest.frozen import frozen
from mosaico_ingest.manifest.compose import Composer, LimitExceeded, Path, Value, member

__all__ = ["MAX_CHARACTERS", "Path", "Source", "Value", "load_source", "member"]

MAX_CHARACTERS = 1_000_000
"""How long a document may be; it also bounds the time a hostile one takes."""

_MAX_RECOVERIES = 100
# The C parser is ten times faster and reads the same language.
_LOADER: type[yaml.SafeLoader] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_RESERVED = "@`%"
_INDICATORS = ("scanning a tag", "parsing a tag", "scanning an alias", "scanning an anchor")
_REMEDIES = (
    (
        "mapping values are not allowed",
        "a second key starts here",
        "quote the value, or check the indentation",
    ),
    ("expected key", "this does not line up with the keys above", "keys of one mapping start in one column"),
    ("expected <block end>", "this does not line up with what is above", "check the indentation"),
    ("unexpected end of stream", "the quote that opens here is never closed", "close it"),
    ("expected ',' or ']'", "the list [ … is not closed", "close it, and quote what contains , [ ] { }"),
    ("expected ',' or '}'", "the mapping { … is not closed", "close it, and quote what contains , [ ] { }"),
    (
        "sequence entries are not allowed",
        "a list item cannot start here",
        "put each item on a line of its own",
    ),
    (
        "unknown escape",
        "unknown escape in a double-quoted text",
        "use single quotes, or double the backslash",
    ),
)
_UNPRINTABLE = re.compile(r"[^\t\n\r\x20-\x7e\x85\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@frozen
class Source:
    """A YAML document: its value, the place of everything in it, and what is wrong with its writing.

    Paths are tuples of keys and list positions; `()` is the whole document.
    """

    file: str
    text: str
    value: Value
    """Plain values, also where there are findings, so that a second look can find the rest."""
    findings: tuple[Finding, ...] = ()
    spans: dict[Path, Span] = field(default_factory=dict[Path, Span])
    key_spans: dict[Path, Span] = field(default_factory=dict[Path, Span])
    others: dict[str, str] = field(default_factory=dict[str, str])
    """The texts of the other files that places are in, by their names."""

    def span(self, path: Path) -> Span:
        """Return the place of the value at `path`, or of the nearest thing around it that is written."""
        for length in range(len(path), -1, -1):
            if path[:length] in self.spans:
                return self.spans[path[:length]]
        return Span(self.file, 1, 1, 1, 1)

    def key_span(self, path: Path) -> Span:
        """Return the place of the key that `path` ends with, or the place of its value (a list has no keys)."""
        return self.key_spans.get(path) or self.span(path)

    def inner_span(self, path: Path, start: int, end: int) -> Span:
        """Return the place of the characters `start:end` of the string at `path`, or of all of it if it is folded."""
        whole = self.span(path)
        line = self.line(whole)
        written = line[whole.column - 1 : whole.end_column - 1] if whole.line == whole.end_line else ""
        value = written[1:-1] if written[:1] in {'"', "'"} else written
        if not value or self.at(path) != value:
            return whole
        first = whole.column + (len(written) - len(value)) // 2
        return Span(whole.file, whole.line, first + start, whole.line, first + end)

    def line(self, span: Span) -> str:
        """Return the line in which a place begins, without its end; empty beyond the last."""
        text = self.text if span.file == self.file else self.others.get(span.file, "")
        lines = text.splitlines()
        return lines[span.line - 1] if 0 < span.line <= len(lines) else ""

    def at(self, path: Path) -> Value:
        """Return the value at `path`, None where there is none."""
        value = self.value
        try:
            for part in path:
                value = member(value, part)
        except LookupError:
            return None
        return value


def load_source(text: str, *, file: str) -> Source:
    """Read YAML; never raises: what is wrong is in the findings, and the value is what could be read."""
    text = text.removeprefix("\ufeff")
    if len(text) > MAX_CHARACTERS:
        message = f"the document has {len(text)} characters; {MAX_CHARACTERS} are allowed"
        return Source(file, text[:1000], None, (_finding("yaml-size", message, Span(file, 1, 1, 1, 1)),))
    unprintable = _UNPRINTABLE.search(text)
    if unprintable is not None:
        span = _place(text, unprintable.start(), file)
        message = f"the character U+{ord(unprintable.group()):04X} is not allowed in YAML"
        return Source(file, text, None, (_finding("yaml-character", message, span, "remove it"),))
    return _Reader(text, file).read()


class _Reader:
    """Reads again with the faulty characters blanked out, until the whole document has been seen."""

    def __init__(self, text: str, file: str) -> None:
        self._original = text
        self._text = text
        self._file = file
        self._findings: list[Finding] = []

    def read(self) -> Source:
        """Return the document."""
        for _ in range(_MAX_RECOVERIES):
            composer = Composer(self._events(), file=self._file, text=self._text, original=self._original)
            try:
                root = composer.document()
            except LimitExceeded as limit:
                return self._failed([*composer.findings, limit.finding])
            except yaml.MarkedYAMLError as error:
                if not self._recover(error):
                    return self._failed([*composer.findings, *self._syntax(error)])
            else:
                findings = (*self._findings, *composer.findings)
                spans = {(): root.span, **root.inner}
                return Source(self._file, self._original, root.value, findings, spans, root.keys)
        return self._failed([])

    def _events(self) -> Iterator[yaml.Event]:
        yield from yaml.parse(self._text, Loader=_LOADER)  # lazily, so that every error comes while composing

    def _failed(self, findings: list[Finding]) -> Source:
        return Source(self._file, self._original, None, (*self._findings, *findings))

    def _recover(self, error: yaml.MarkedYAMLError) -> bool:
        """Blank out what the error is about, if that leaves the rest of the document as it was meant."""
        mark = error.problem_mark
        if mark is None:
            return False
        here = self._text[mark.index : mark.index + 1]
        if error.context_mark is not None and any(kind in (error.context or "") for kind in _INDICATORS):
            return self._blank(error.context_mark.index)
        if here == "\t":
            return self._untab(mark)
        if here and here in _RESERVED:
            return self._blank(mark.index)
        return self._unbrace(mark.index)

    def _blank(self, *indices: int) -> bool:
        """Put an underscore in place of characters; False if that was done before."""
        if any(self._text[index] == "_" for index in indices):
            return False
        for index in indices:
            self._text = f"{self._text[:index]}_{self._text[index + 1 :]}"
        return True

    def _untab(self, mark: yaml.Mark) -> bool:
        tabs = len(self._text[mark.index :]) - len(self._text[mark.index :].lstrip("\t"))
        self._text = self._text[: mark.index] + " " * tabs + self._text[mark.index + tabs :]
        span = Span(self._file, mark.line + 1, mark.column + 1, mark.line + 1, mark.column + 1 + tabs)
        self._findings.append(_finding("yaml-tab", "a tab; YAML is indented with spaces", span, "use spaces"))
        return True

    def _unbrace(self, index: int) -> bool:
        """Blank out the braces of `{stem}_x` and of a `${VAR}` inside `{ }`, which were meant as text."""
        if self._text[index - 1 : index + 1] == "${":
            opening, closing = index, self._text.find("}", index)
        elif self._text[index - 1 : index] == "}":
            opening, closing = self._text.rfind("{", 0, index), index - 1
        else:
            return False
        inside = self._text[opening + 1 : closing]
        return (
            0 <= opening < closing and inside.isprintable() and inside != "" and self._blank(opening, closing)
        )

    def _syntax(self, error: yaml.MarkedYAMLError) -> list[Finding]:
        if any(finding.rule == "yaml-tab" for finding in self._findings):
            return []  # what follows a tab is said by the tab
        problem = error.problem or "this is not YAML"
        message, remedy = next(
            ((text, remedy) for part, text, remedy in _REMEDIES if part in problem), (problem, None)
        )
        mark = (
            error.context_mark if "never closed" in message or "not closed" in message else error.problem_mark
        )
        index = 0 if mark is None else mark.index
        return [_finding("yaml-syntax", message, _place(self._original, index, self._file), remedy)]


def _finding(rule: str, message: str, span: Span, remedy: str | None = None) -> Finding:
    return Finding(rule, Severity.ERROR, message, span, remedy)


def _place(text: str, index: int, file: str) -> Span:
    before = text[:index]
    line = before.count("\n") + 1
    column = index - (before.rfind("\n") + 1) + 1
    return Span(file, line, column, line, column + 1)
