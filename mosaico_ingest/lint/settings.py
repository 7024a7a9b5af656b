"""This file is what a project says about linting, in `.ingest.yaml` or under `[tool.ingest.lint]` of pyproject.toml."""

from __future__ import annotations

import sys
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from typing import Literal

from msgspec import Struct
from pydantic import BaseModel, ConfigDict, ValidationError

from mosaico_ingest.errors import ManifestError
from mosaico_ingest.findings import Finding, Severity, Span
from mosaico_ingest.job.manifest import read_text
from mosaico_ingest.job.validation import explain, nearest
from mosaico_ingest.job.yaml_source import Source, Value, load_source
from mosaico_ingest.rules import LINT_RULES

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

__all__ = ["NAMES", "Settings", "settings_for"]

NAMES = {name: rule.id for rule in LINT_RULES.values() for name in (rule.id, rule.code)}
"""Every code and every name of a rule, to its name."""


class _Lint(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    severity: dict[str, Literal["error", "warning", "info", "off"]] = {}
    """How much each rule matters, by code or name."""
    exclude: tuple[str, ...] = ()
    """Globs of paths, seen from the settings' folder, that are not judged when a folder is."""


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    lint: _Lint = _Lint()


class Settings(Struct, frozen=True):
    """How much each rule matters here, and which files are left alone."""

    severities: tuple[tuple[str, Severity | None], ...] = ()
    exclude: tuple[str, ...] = ()
    folder: Path = Path()

    def apply(self, finding: Finding) -> Finding | None:
        """Return the finding with the severity it has here, None if the rule is off."""
        for rule, severity in self.severities:
            if rule == finding.rule:
                if severity is None:
                    return None
                return Finding(rule, severity, finding.message, finding.span, finding.help, finding.fix)
        return finding

    def excludes(self, path: Path) -> bool:
        """Say whether a file is left alone when its folder is judged."""
        try:
            relative = path.resolve().relative_to(self.folder.resolve()).as_posix()
        except ValueError:
            return False
        return any(fnmatchcase(relative, pattern) for pattern in self.exclude)


def settings_for(folder: Path) -> Settings:
    """Return the settings of the nearest folder above that has any.

    Raises:
        ManifestError: They cannot be read; `findings` says why.
    """
    return _settings(folder.resolve())


@lru_cache(maxsize=256)
def _settings(folder: Path) -> Settings:
    own, project = folder / ".ingest.yaml", folder / "pyproject.toml"
    if own.is_file():
        return _checked(load_source(read_text(own), file=str(own)), folder)
    if project.is_file():
        lint = _lint_table(project)
        if lint is not None:
            return _checked(Source(str(project), read_text(project), {"lint": lint}), folder)
    return Settings(folder=folder) if folder == folder.parent else _settings(folder.parent)


def _lint_table(path: Path) -> Value:
    try:
        return tomllib.loads(read_text(path)).get("tool", {}).get("ingest", {}).get("lint")
    except tomllib.TOMLDecodeError as error:
        raise ManifestError(f"is not TOML: {error}", where=str(path)) from error


def _checked(source: Source, folder: Path) -> Settings:
    findings = list(source.findings)
    try:
        file = _File.model_validate(source.value or {})
    except ValidationError as error:
        findings += [
            finding for _, finding in explain(error, source=source, schema=_File.model_json_schema())
        ]
        file = _File()
    findings += [_unknown(rule, source) for rule in file.lint.severity if rule not in NAMES]
    if findings:
        first = findings[0]
        raise ManifestError(first.message, where=str(first.span), hint=first.help, findings=tuple(findings))
    severities = tuple(
        (NAMES[rule], None if severity == "off" else Severity(severity))
        for rule, severity in file.lint.severity.items()
    )
    return Settings(severities, file.lint.exclude, folder)


def _unknown(rule: str, source: Source) -> Finding:
    span = source.key_span(("lint", "severity", rule)) if source.spans else Span(source.file, 1, 1, 1, 1)
    close = nearest(rule, NAMES)
    hint = f"did you mean {close!r}?" if close else "`ingest lint --explain all` lists them"
    return Finding("unknown-rule", Severity.ERROR, f"there is no rule {rule!r}", span, hint)
