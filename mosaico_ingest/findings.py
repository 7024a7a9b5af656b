"""Findings: one diagnostic with rule id, severity, message, location and hint, from lint, plan or run."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from enum import Enum

from msgspec import Struct

__all__ = [
    "Edit",
    "Finding",
    "RowFailure",
    "Severity",
    "Span",
    "Stage",
    "a_few",
    "encodable",
    "offered",
    "one_line",
]

_ESCAPED_BYTES = 0xDC00
"""Where Python puts the bytes of a file name that it cannot decode."""
_SURROGATES = re.compile("[\ud800-\udfff]")
_UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters, line ends and what turns the direction of writing, which deceive a reader's terminal."""


def encodable(text: str) -> str:
    r"""Return the text with the bytes of a file name that are no UTF-8 spelled as `\xff`."""
    return _SURROGATES.sub(_spelled, text)


def one_line(text: str) -> str:
    r"""Return the text with everything that does not print spelled as an escape, as `\x1b` or `\n`."""
    return _UNPRINTABLE.sub(_spelled, text)


def a_few(names: Iterable[str], *, most: int = 8) -> str:
    """Return the first names in the order of letters, and how many more there are."""
    known = sorted(names)
    more = f" and {len(known) - most:,} more" if len(known) > most else ""
    return f"{', '.join(known[:most])}{more}"


def offered(names: Iterable[str], wanted: Iterable[str] = ()) -> str:
    """Return what there is in place of what was wanted, as a hint: the nearest, then a few."""
    known = sorted(names)
    close = (get_close_matches(word, known, n=1, cutoff=0.5) for word in wanted if word[:1] != "!")
    near = dict.fromkeys(name for found in close for name in found)
    listed = f"there are {a_few(known)}" if known else "there are none"
    return f"the nearest is {a_few(near)}; {listed}" if near else listed


def _spelled(match: re.Match[str]) -> str:
    byte = ord(match[0]) - _ESCAPED_BYTES
    return f"\\x{byte:02x}" if byte in range(0x80, 0x100) else match[0].encode("unicode_escape").decode()


class Severity(str, Enum):
    """How much a finding matters."""

    ERROR = "error"
    WARNING = "warning"
    INFO = "info"


@dataclass(frozen=True, slots=True, order=True)
class Span:
    """A stretch of text: 1-based line and column of its first character and one past its last."""

    file: str
    line: int
    column: int
    end_line: int
    end_column: int

    def __str__(self) -> str:
        """Return `file:line:column`, which terminals make clickable."""
        return f"{self.file}:{self.line}:{self.column}"


class Edit(Struct, frozen=True):
    """A change that mends a finding: the text of `span` becomes `text`."""

    span: Span
    text: str


class Finding(Struct, frozen=True):
    """One thing to know: which rule, where, what, and the remedy."""

    rule: str
    """The rule's name in kebab-case, as `unknown-key`."""
    severity: Severity
    message: str
    """What is wrong, with the value, in one line."""
    span: Span | None = None
    help: str | None = None
    """What to do about it, in one line."""
    fix: Edit | None = None
    """The same as a change of the text, where it is safe to make without asking."""

    def __str__(self) -> str:
        """Return the finding in one line, without the source excerpt."""
        place = f"{self.span}: " if self.span else ""
        text = f"{place}{self.severity.value}[{self.rule}] {self.message}"
        return one_line(f"{text} — {self.help}" if self.help else text)


class Stage(str, Enum):
    """Where in the pipeline a row was lost."""

    READ = "read"
    DECODE = "decode"
    ADAPT = "adapt"
    WRITE = "write"


class RowFailure(Struct, frozen=True):
    """One row that could not go on: its position in the batch that was given, the rule it broke, and why."""

    row: int
    rule: str
    """A short kebab-case name that failures can be counted by, as `cdr-length`, `nan`, `out-of-range`."""
    reason: str
    """What was expected and what was found, in one line."""
