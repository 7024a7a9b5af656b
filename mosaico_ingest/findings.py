"""Findings and rejected rows: diagnostics with rule id, severity, message, location and hint, and text helpers for them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from difflib import get_close_matches
from enum import Enum

from msgspec import Struct


class Severity(str, Enum):
    """The severity of a finding."""

    ERROR = "error"
    WARNING = "warning"
    INFO = "info"


class Span(Struct, frozen=True, order=True):
    """A range of text. Lines and columns start at 1, and the end column is exclusive."""

    file: str
    line: int
    column: int
    end_line: int
    end_column: int

    def __str__(self) -> str:
        """Return `file:line:column`, which many terminals turn into a link."""
        return f"{self.file}:{self.line}:{self.column}"


class Edit(Struct, frozen=True):
    """A fix: replace the text of `span` with `text`."""

    span: Span
    text: str


class Finding(Struct, frozen=True):
    """One diagnostic of lint, plan or run."""

    rule: str
    """The id of the rule, such as `unknown-key`; see `mosaico_ingest.rules`."""
    severity: Severity
    message: str
    """The problem and the value, in one line."""
    span: Span | None = None
    help: str | None = None
    """A hint that starts with an imperative, in one line."""
    fix: Edit | None = None
    """The fix, if it is safe to apply without asking."""

    def __str__(self) -> str:
        """Return the finding in one line, without the source excerpt."""
        location = f"{self.span}: " if self.span else ""
        text = f"{location}{self.severity.value}[{self.rule}] {self.message}"
        return one_line(f"{text} — {self.help}" if self.help else text)


class Stage(str, Enum):
    """The stage of the pipeline that rejected a row."""

    READ = "read"
    DECODE = "decode"
    ADAPT = "adapt"
    WRITE = "write"


class RowFailure(Struct, frozen=True):
    """A rejected row."""

    row: int
    """The position of the row in its batch."""
    rule: str
    """The id of the rule, such as `out-of-range`; see `mosaico_ingest.rules`."""
    reason: str
    """The problem and the value, in one line."""


_SURROGATES = re.compile("[\ud800-\udfff]")
_FIRST_SURROGATE = 0xDC00
"""Python decodes the undecodable byte `b` of a file name as the character with the code `0xDC00 + b`."""
_UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters, line separators and direction marks, which can disguise text in a terminal."""


def escape_undecodable(text: str) -> str:
    r"""Return the text with the undecodable bytes of file names escaped as `\xff`."""
    return _SURROGATES.sub(_escape, text)


def one_line(text: str) -> str:
    r"""Return the text with unprintable characters escaped, such as `\x1b` or `\n`, and credentials masked."""
    return _UNPRINTABLE.sub(_escape, mask_credentials(text))


def _escape(match: re.Match[str]) -> str:
    byte = ord(match[0]) - _FIRST_SURROGATE
    return f"\\x{byte:02x}" if byte in range(0x80, 0x100) else match[0].encode("unicode_escape").decode()


_CREDENTIALS = re.compile(
    r"(?P<user>(?<=://)[^/@\s\"']+(?=@))"
    r"|(?P<api_key>msco_[a-z0-9]{32}_[0-9a-f]{8})"
    r"|(?P<option>(?<=[?&])[^=&?\s\"']+=)(?P<value>[^&\s\"']+)",
    re.IGNORECASE,
)
"""User names and passwords in URLs, API keys, and the options of URLs."""
_SECRET_OPTION = re.compile(
    r"key|password|token|secret|signature|credential|policy|\bsig=|accessid", re.IGNORECASE
)
_MASK = "***"


def has_credentials(text: str) -> bool:
    """Return whether a text contains an API key, or a URL with credentials that are not a variable."""
    return any(_is_secret(match) and "${" not in match[0] for match in _CREDENTIALS.finditer(text))


def mask_credentials(text: str, *, same_length: bool = False) -> str:
    """Return the text with API keys and the credentials in URLs replaced by `***`, or by as many `*` as characters."""

    def mask(match: re.Match[str]) -> str:
        if not _is_secret(match):
            return match[0]
        option = match["option"] or ""
        return option + ("*" * (len(match[0]) - len(option)) if same_length else _MASK)

    return _CREDENTIALS.sub(mask, text)


def _is_secret(match: re.Match[str]) -> bool:
    return match["option"] is None or _SECRET_OPTION.search(match["option"]) is not None


def join_names(names: Iterable[str], *, most: int = 8) -> str:
    """Return the first `most` names in alphabetical order, separated by commas, and the number of the others."""
    ordered = sorted(names)
    more = f" and {len(ordered) - most:,} more" if len(ordered) > most else ""
    return f"{', '.join(ordered[:most])}{more}"


def suggest_names(names: Iterable[str], wanted: Iterable[str] = ()) -> str:
    """Return a hint that lists the available names, and the nearest ones to the wanted words first."""
    available = sorted(names)
    matches = (get_close_matches(word, available, n=1, cutoff=0.5) for word in wanted if word[:1] != "!")
    nearest = dict.fromkeys(name for match in matches for name in match)
    listing = f"there are {join_names(available)}" if available else "there are none"
    return f"the nearest is {join_names(nearest)}; {listing}" if nearest else listing


_ONE_LETTER, _SIMILAR = 0.8, 0.6
"""Minimum ratios of `difflib` for words that differ in one letter, and for similar words."""


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Return the known word that is closest to `word`; None if none is close.

    A typo of one letter comes first, then a longer word that starts or ends with the word, then worse typos.
    """
    plain = {normalized_word(candidate): candidate for candidate in known}
    own = normalized_word(word)
    close = get_close_matches(own, plain, n=1, cutoff=_ONE_LETTER)
    if not close:
        longer = [name for name in plain if name.endswith(f"_{own}") or name.startswith(f"{own}_")]
        close = longer if len(longer) == 1 else get_close_matches(own, plain, n=1, cutoff=_SIMILAR)
    return plain[close[0]] if close else None


def normalized_word(word: str) -> str:
    """Return a word in lower case, with an underscore in place of hyphens and spaces."""
    return re.sub(r"[-\s]+", "_", word.strip().lower())
