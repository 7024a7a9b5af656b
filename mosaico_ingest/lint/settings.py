"""The findings that lint reports: the settings of a project, and comments that suppress findings."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
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
from mosaico_ingest.rules import LINT_RULES, find_rule

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_RULE_IDS = {name: rule.id for rule in LINT_RULES.values() for name in (rule.id, rule.code)}
"""The id of each lint rule, by id and by code."""


_COMMENT = re.compile(r"#\s*ingest:\s*(?P<action>[\w-]+)(?:\s*\[(?P<rules>[^\]\n]*)\]?)?")
_ACTIONS = ("ignore", "ignore-file")
_WORD = re.compile(r"[^\s,]+")
_REMEDY = "name a rule in brackets, such as `# ingest: ignore[yaml-boolean]`"


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


@dataclass(slots=True)
class Ignore:
    """One rule that a comment suppresses, or a comment that names no rule."""

    rule: str
    """The id or code as written; empty if the comment names no rule."""
    span: Span
    lines: range
    """The affected lines: the line of the comment, the next line if the comment stands alone, or the entire file."""
    used: bool = False


def ignores_in(text: str, *, file: str) -> list[Ignore]:
    """Return the rules that the comments of a text suppress."""
    lines = text.splitlines()
    return [
        ignore
        for number, line in enumerate(lines, 1)
        for comment in _COMMENT.finditer(line)
        for ignore in _ignores(comment, Span(file, number, 1, number, 1), range(1, len(lines) + 2))
    ]


def apply_ignores(findings: Iterable[Finding], ignores: Sequence[Ignore]) -> list[Finding]:
    """Return the findings that no comment suppresses, and a finding for each comment that suppresses nothing."""
    remaining = [finding for finding in findings if not _is_suppressed(finding, ignores)]
    return remaining + [_useless(ignore) for ignore in ignores if not ignore.used]


def _ignores(comment: re.Match[str], line: Span, file_lines: range) -> Iterable[Ignore]:
    action = comment["action"]
    if action not in _ACTIONS and not get_close_matches(action, _ACTIONS, n=1, cutoff=0.7):
        return
    stands_alone = not comment.string[: comment.start()].strip()
    first = line.line + stands_alone
    lines = file_lines if action == "ignore-file" else range(first, first + 1)
    words = list(_WORD.finditer(comment["rules"] or "")) if action in _ACTIONS else []
    for word in words:
        start = comment.start("rules") + word.start() + 1
        yield Ignore(word[0], Span(line.file, line.line, start, line.line, start + len(word[0])), lines)
    if not words:
        span = Span(line.file, line.line, comment.start() + 1, line.line, comment.end() + 1)
        yield Ignore("", span, lines)


def _is_suppressed(finding: Finding, ignores: Sequence[Ignore]) -> bool:
    line = finding.span.line if finding.span else 0
    matches = [item for item in ignores if line in item.lines and _lint_rule(item.rule) == finding.rule]
    for ignore in matches:
        ignore.used = True
    return bool(matches)


def _lint_rule(name: str) -> str | None:
    rule = find_rule(name)
    return rule.id if rule is not None and rule.is_lint else None


def _useless(ignore: Ignore) -> Finding:
    if _lint_rule(ignore.rule) is not None:
        message = f"{ignore.rule} reports nothing here"
        return Finding("unused-ignore", Severity.WARNING, message, ignore.span, "remove it from the comment")
    if not ignore.rule:
        message = "the comment suppresses nothing, because it names no rule"
        return Finding("unknown-rule", Severity.WARNING, message, ignore.span, _REMEDY)
    if find_rule(ignore.rule) is not None:
        message = f"{ignore.rule} is reported by plan or run, which ignore comments do not affect"
        return Finding("unknown-rule", Severity.WARNING, message, ignore.span, "remove it from the comment")
    close = get_close_matches(ignore.rule, LINT_RULES, n=1)
    hint = f"did you mean {close[0]!r}?" if close else "see `ingest lint --explain all`"
    return Finding("unknown-rule", Severity.WARNING, f"there is no rule {ignore.rule!r}", ignore.span, hint)
