"""The lint settings of a project, from `.ingest.yaml` or the table `[tool.ingest.lint]` of `pyproject.toml`."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from typing import Literal

from msgspec import Struct, field
from msgspec.structs import replace
from pydantic import BaseModel, ConfigDict, ValidationError

from mosaico_ingest.errors import ManifestError
from mosaico_ingest.findings import Finding, Severity, Span, nearest
from mosaico_ingest.job.manifest import read_text
from mosaico_ingest.job.validation import explain
from mosaico_ingest.job.yaml_source import Source, Value, load_source
from mosaico_ingest.rules import LINT_RULES

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_RULE_IDS = {name: rule.id for rule in LINT_RULES.values() for name in (rule.id, rule.code)}
"""The id of each lint rule, by id and by code."""


class _Lint(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    severity: dict[str, Literal["error", "warning", "info", "off"]] = {}
    """Severities of rules, by id or code."""
    exclude: tuple[str, ...] = ()
    """Globs of paths, relative to the folder of the settings, that lint skips in folders."""


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    lint: _Lint = _Lint()


class Settings(Struct, frozen=True):
    """The lint settings that apply to a folder."""

    severities: Mapping[str, Severity | None] = field(default_factory=dict[str, "Severity | None"])
    """Configured severities by rule id. None turns the rule off."""
    exclude: tuple[str, ...] = ()
    folder: Path = Path()
    """The folder that contains the settings file."""

    def apply(self, finding: Finding) -> Finding | None:
        """Return the finding with its configured severity, or None if its rule is off."""
        severity = self.severities.get(finding.rule, finding.severity)
        return None if severity is None else replace(finding, severity=severity)

    def excludes(self, path: Path) -> bool:
        """Return whether lint skips a file when it checks a folder."""
        try:
            relative = path.resolve().relative_to(self.folder.resolve()).as_posix()
        except ValueError:
            return False
        return any(fnmatchcase(relative, pattern) for pattern in self.exclude)


def settings_for(folder: Path) -> Settings:
    """Return the settings of the folder or its nearest parent that has settings.

    Raises:
        ManifestError: The settings cannot be read or are invalid.
    """
    return _settings(folder.resolve())


@lru_cache(maxsize=256)
def _settings(folder: Path) -> Settings:
    own, project = folder / ".ingest.yaml", folder / "pyproject.toml"
    if own.is_file():
        return _validated(load_source(read_text(own), file=str(own)), folder)
    if project.is_file():
        table = _lint_table(project)
        if table is not None:
            return _validated(Source(str(project), read_text(project), {"lint": table}), folder)
    return Settings(folder=folder) if folder == folder.parent else _settings(folder.parent)


def _lint_table(path: Path) -> Value:
    try:
        return tomllib.loads(read_text(path)).get("tool", {}).get("ingest", {}).get("lint")
    except tomllib.TOMLDecodeError as error:
        raise ManifestError(f"the file is not valid TOML: {error}", where=str(path)) from error


def _validated(source: Source, folder: Path) -> Settings:
    findings = list(source.findings)
    try:
        file = _File.model_validate(source.value or {})
    except ValidationError as error:
        findings += [
            finding for _, finding in explain(error, source=source, schema=_File.model_json_schema())
        ]
        file = _File()
    findings += [_unknown_rule(rule, source) for rule in file.lint.severity if rule not in _RULE_IDS]
    if findings:
        first = findings[0]
        raise ManifestError(first.message, where=str(first.span), hint=first.help, findings=tuple(findings))
    severities = {
        _RULE_IDS[rule]: None if severity == "off" else Severity(severity)
        for rule, severity in file.lint.severity.items()
    }
    return Settings(severities, file.lint.exclude, folder)


def _unknown_rule(rule: str, source: Source) -> Finding:
    span = source.key_span(("lint", "severity", rule)) if source.spans else Span(source.file, 1, 1, 1, 1)
    close = nearest(rule, _RULE_IDS)
    hint = f"did you mean {close!r}?" if close else "see `ingest lint --explain all`"
    return Finding("unknown-rule", Severity.ERROR, f"lint has no rule {rule!r}", span, hint)
