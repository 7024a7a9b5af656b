"""Named patterns of file names, such as `{vehicle}_{date:%Y%m%d}_{run:int}.mcap`."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from datetime import datetime
from functools import cached_property, partial
from typing import TypeAlias

from mosaico_ingest.findings import nearest

FileNameValue: TypeAlias = "str | int | float"

_FIELD = re.compile(r"\{\{|\}\}|\{(?P<name>[^{}:]*)(?::(?P<kind>[^{}]*))?\}|(?P<stray>[{}])")
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_IGNORED = "_"
"""The name of a field that matches any text and becomes no metadata."""
_KINDS: Mapping[str, tuple[str, Callable[[str], FileNameValue]]] = {
    "text": (r"[^/]+?", str),
    "int": (r"[0-9]+", int),
    "float": (r"[0-9]+(?:\.[0-9]+)?", float),
}
"""The regular expression and the conversion of each kind of field."""
_DIRECTIVES = {
    "Y": "[0-9]{4}", "m": "[0-9]{2}", "d": "[0-9]{2}", "H": "[0-9]{2}", "M": "[0-9]{2}", "S": "[0-9]{2}",
    "y": "[0-9]{2}", "j": "[0-9]{3}", "I": "[0-9]{2}", "p": "[AaPp][Mm]", "b": "[A-Za-z]{3}", "B": "[A-Za-z]{3,9}",
    "f": "[0-9]{1,6}", "z": "(?:[+-][0-9]{2}:?[0-9]{2}|Z)", "%": "%",
}  # fmt: skip
"""The regular expression of each date directive."""
_DATE, _TIME = frozenset("YmdyjbB"), frozenset("HMSIpfz")


class FileNamePattern:
    """A pattern of file names whose fields become metadata.

    `{name}` matches text, `{name:int}` and `{name:float}` match numbers, `{name:%Y%m%d}` matches a date, and `{_}` matches
    text that is ignored. A pattern with `/` also matches the names of the folders.
    """

    def __init__(self, text: str) -> None:
        """Parse a pattern.

        Raises:
            ValueError: A field has no valid name or kind, or occurs twice.
        """
        self.text = text
        self._conversions: dict[str, Callable[[str], FileNameValue]] = {}
        parts: list[str] = []
        position = 0
        for match in _FIELD.finditer(text):
            parts += [re.escape(text[position : match.start()]), self._field(match)]
            position = match.end()
        self._expression = "".join((*parts, re.escape(text[position:])))
        if not self._conversions:
            raise ValueError(f"{text!r} has no field; write a pattern such as {{vehicle}}_{{run:int}}.mcap")

    def __repr__(self) -> str:
        """Return the constructor call."""
        return f"FileNamePattern({self.text!r})"

    def __str__(self) -> str:
        """Return the pattern as written."""
        return self.text

    def __eq__(self, other: object) -> bool:
        """Compare the texts."""
        return isinstance(other, FileNamePattern) and other.text == self.text

    def __hash__(self) -> int:
        """Return the hash of the text."""
        return hash(self.text)

    def __reduce__(self) -> tuple[type[FileNamePattern], tuple[str]]:
        """Pickle the text only."""
        return FileNamePattern, (self.text,)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the fields, in their order."""
        return tuple(self._conversions)

    @property
    def depth(self) -> int:
        """The number of path components that the pattern matches: 1 for a file name."""
        return self.text.count("/") + 1

    def match(self, name: str) -> dict[str, FileNameValue] | None:
        """Return the value of each field, or None if the name does not match or has an impossible date.

        Dates become ISO texts: `2026-03-01`, `12:30:00`, or `2026-03-01T12:30:00`.
        """
        match = self._compiled.fullmatch(name)
        if match is None:
            return None
        try:
            return {field: convert(match[field]) for field, convert in self._conversions.items()}
        except ValueError:  # such as the month 13
            return None

    @cached_property
    def _compiled(self) -> re.Pattern[str]:
        return re.compile(self._expression)

    def _field(self, match: re.Match[str]) -> str:
        """Return the regular expression of a field or of an escaped brace."""
        if match[0] in {"{{", "}}"}:
            return re.escape(match[0][0])
        if match["stray"]:
            raise ValueError(f"a single {match[0]} in {self.text!r}; write {match[0] * 2} for a brace")
        name, kind = match["name"], match["kind"] or "text"
        if not _NAME.fullmatch(name):
            raise ValueError(f"{match[0]} has no valid name; use letters, digits and _")
        if name in self._conversions:
            raise ValueError(f"the field {name!r} occurs twice")
        if "%" in kind:
            expression, convert = _date_field(kind)
        elif kind in _KINDS:
            expression, convert = _KINDS[kind]
        else:
            close = nearest(kind, _KINDS)
            hint = (
                f"did you mean {close!r}?" if close else f"use {', '.join(_KINDS)}, or a date such as %Y%m%d"
            )
            raise ValueError(f"{match[0]} has the unknown kind {kind!r}; {hint}")
        if name == _IGNORED:
            return f"(?:{expression})"
        self._conversions[name] = convert
        return f"(?P<{name}>{expression})"


def _date_field(template: str) -> tuple[str, Callable[[str], FileNameValue]]:
    """Return the regular expression and the conversion of a date field."""
    parts: list[str] = []
    directives: set[str] = set()
    position = 0
    for match in re.finditer("%(.?)", template):
        directive = match[1]
        if directive not in _DIRECTIVES:
            raise ValueError(
                f"%{directive} in {template!r} is not a date directive; use {', '.join(f'%{d}' for d in _DIRECTIVES)}"
            )
        directives.add(directive)
        parts += [re.escape(template[position : match.start()]), _DIRECTIVES[directive]]
        position = match.end()
    has_date, has_time = bool(directives & _DATE), bool(directives & _TIME)
    expression = "".join((*parts, re.escape(template[position:])))
    return expression, partial(_iso_text, template, has_date=has_date, has_time=has_time)


def _iso_text(template: str, text: str, *, has_date: bool, has_time: bool) -> str:
    moment = datetime.strptime(text, template)  # noqa: DTZ007 - the pattern decides whether there is a zone
    if has_date and has_time:
        return moment.isoformat()
    return moment.date().isoformat() if has_date else moment.timetz().isoformat()
