"""This file fills in `${VAR}`, `${VAR:-default}`, `${VAR:?why}` and `$$`, wherever a manifest has a text."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from mosaico_ingest.diagnostics import Finding, Severity
from mosaico_ingest.manifest.source import Path, Source, Value

__all__ = ["Filled", "fill_in"]

_REFERENCE = re.compile(r"\$(?:(\$)|\{([^{}]*)\}|(?=\{))")
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


def fill_in(source: Source, env: Mapping[str, str] | None) -> Filled:
    """Fill in the variables of every text; without `env` only those with a default, and none is missed."""
    filled = Filled(None)
    filled.value = _value(source.value, (), source, env, filled)
    return filled


def _value(value: Value, path: Path, source: Source, env: Mapping[str, str] | None, out: Filled) -> Value:
    if isinstance(value, dict):
        return {key: _value(inner, (*path, key), source, env, out) for key, inner in value.items()}
    if isinstance(value, list):
        return [_value(inner, (*path, index), source, env, out) for index, inner in enumerate(value)]
    if isinstance(value, str) and "$" in value:
        return _text(value, path, source, env, out)
    return value


def _text(text: str, path: Path, source: Source, env: Mapping[str, str] | None, out: Filled) -> str:
    def replace(match: re.Match[str]) -> str:
        if match[1]:
            return "$"
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
        if env is not None and env.get(name):
            return env[name]
        if operator == "-":
            return rest
        out.unknown.add(path)
        if env is not None:
            why = f": {rest}" if operator == "?" and rest else ""
            report("unset-variable", f"{name} is not set{why}", f"set {name} in the environment", match)
        return match[0]

    def report(rule: str, message: str, remedy: str, match: re.Match[str]) -> None:
        span = source.inner_span(path, match.start(), max(match.end(), match.start() + 1))
        out.findings.append(Finding(rule, Severity.ERROR, message, span, remedy))

    return _REFERENCE.sub(replace, text)
