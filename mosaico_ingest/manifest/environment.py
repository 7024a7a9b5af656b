"""This file fills in `${VAR}`, `${VAR:-default}`, `${VAR:?why}` and `$$`, wherever a manifest has a text."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from mosaico_ingest.diagnostics import Finding, Severity
from mosaico_ingest.frozen import frozen
from mosaico_ingest.manifest.matrix import combinations, variables
from mosaico_ingest.manifest.source import Path, Source, Value

__all__ = ["Filled", "fill_in", "fill_in_cell"]

_REFERENCE = re.compile(r"\$(?:(\$)|\{([^{}]*)\}|(?=\{))")
_WITHOUT = {("extends",), ("defaults",), ("matrix",)}
"""Sections in which there are no variables."""
_INSIDE = re.compile(r"([A-Za-z_][A-Za-z0-9_]*)(?::([-?])(.*))?", re.DOTALL)


@dataclass(slots=True)
class Filled:
    """The document with its variables filled in."""

    value: Value
    findings: list[Finding] = field(default_factory=list[Finding])
    changed: set[Path] = field(default_factory=set[Path])
    """Where a variable was; what stands there now may be a secret."""
    unknown: set[Path] = field(default_factory=set[Path])
    """Where it could not be filled in; the text stands there as written."""


def fill_in(source: Source, env: Mapping[str, str] | None, cell: Mapping[str, str] | None = None) -> Filled:
    """Fill in the variables of every text; without `env` only those with a default, and none is missed.

    The values of `cell` come first (without it, those of the first job of the document's matrix), then those of the
    environment, then the document's own `defaults`.
    """
    known = _Variables(
        combinations(source.value)[0] if cell is None else cell, env, variables(source.at(("defaults",)))
    )
    return _filled(source, known)


def fill_in_cell(source: Source, cell: Mapping[str, str]) -> Filled:
    """Fill in the variables of a matrix and leave every other one as it is written."""
    return _filled(source, _Variables(cell, None, {}, alone=True))


def _filled(source: Source, known: _Variables) -> Filled:
    filled = Filled(None)
    filled.value = _value(source.value, (), source, known, filled)
    return filled


@frozen
class _Variables:
    """The values of variables; of several sources the first that has one wins."""

    cell: Mapping[str, str]
    env: Mapping[str, str] | None
    """None: not looked at, and nothing is missed."""
    defaults: Mapping[str, str]
    alone: bool = False
    """Whether nothing but the cell counts, and all else stays to be filled in later."""

    def get(self, name: str) -> str | None:
        if name in self.cell:
            return self.cell[name]
        return (self.env or {}).get(name) or self.defaults.get(name)


def _value(value: Value, path: Path, source: Source, known: _Variables, out: Filled) -> Value:
    if path in _WITHOUT:
        return value
    if isinstance(value, dict):
        return {key: _value(inner, (*path, key), source, known, out) for key, inner in value.items()}
    if isinstance(value, list):
        return [_value(inner, (*path, index), source, known, out) for index, inner in enumerate(value)]
    if isinstance(value, str) and "$" in value:
        return _text(value, path, source, known, out)
    return value


def _text(text: str, path: Path, source: Source, known: _Variables, out: Filled) -> str:
    def replace(match: re.Match[str]) -> str:
        if match[1]:
            return "$$" if known.alone else "$"
        if known.alone and (match[2] or "").partition(":")[0] not in known.cell:
            return match[0]
        out.changed.add(path)
        inside = _INSIDE.fullmatch(match[2] or "")
        if inside is None:
            report(
                "variable-syntax",
                f"{'${' if match[0] == '$' else match[0]} is no variable",
                "write ${NAME}, or $$ for a dollar",
                match,
            )
            return match[0]
        name, operator, rest = inside.groups()
        value = known.get(name)
        if value is not None:
            return value.replace("$", "$$") if known.alone else value
        if operator == "-":
            return rest
        out.unknown.add(path)
        if known.env is not None:
            why = f": {rest}" if operator == "?" and rest else ""
            report("unset-variable", f"{name} is not set{why}", f"set {name} in the environment", match)
        return match[0]

    def report(rule: str, message: str, remedy: str, match: re.Match[str]) -> None:
        span = source.inner_span(path, match.start(), max(match.end(), match.start() + 1))
        out.findings.append(Finding(rule, Severity.ERROR, message, span, remedy))

    return _REFERENCE.sub(replace, text)
