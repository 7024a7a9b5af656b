"""This file judges documents: reads them, runs the rules, applies comments and settings, and sums up."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from mosaico_ingest.diagnostics import Finding, Severity, Span
from mosaico_ingest.errors import ManifestError
from mosaico_ingest.frozen import frozen
from mosaico_ingest.lint.adapter import adapter_findings
from mosaico_ingest.lint.document import Document, Kind, documents_in
from mosaico_ingest.lint.fix import apply_fixes
from mosaico_ingest.lint.job import Job, read_job
from mosaico_ingest.lint.message import MessageFile, read_message
from mosaico_ingest.lint.rules import RULES
from mosaico_ingest.lint.settings import NAMES, Settings, settings_for
from mosaico_ingest.lint.suppress import apply_ignores, ignores_in
from mosaico_ingest.manifest.extends import KEY as EXTENDS
from mosaico_ingest.manifest.extends import bases_of, extended
from mosaico_ingest.manifest.load import read_text
from mosaico_ingest.manifest.source import load_source

__all__ = ["STDIN", "Judged", "LintReport", "lint_document", "lint_paths"]

STDIN = "-"
_SUFFIXES = (".yaml", ".yml", ".msg", ".md", ".markdown")
_MAX_ROUNDS = 10
_OF_WHOLE = frozenset({"missing-key", "unset-variable"})
"""Rules about what only a whole job must have."""
_EXIT_CODES = {Severity.INFO: 10, Severity.WARNING: 11, Severity.ERROR: 12}


@frozen
class Judged:
    """A file with what was found in it."""

    file: str
    text: str
    findings: tuple[Finding, ...]
    fixed: int = 0
    """How many changes were made."""
    bases: frozenset[str] = frozenset()
    """The files it extends."""


@frozen
class LintReport:
    """Every file that was judged, in the order of their paths."""

    files: tuple[Judged, ...]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All findings, by file, line and column."""
        return tuple(finding for judged in self.files for finding in judged.findings)

    @property
    def exit_code(self) -> int:
        """0 clean, 3 nothing to judge, 10 infos, 11 warnings, 12 errors."""
        if not self.files:
            return 3
        return max((_EXIT_CODES[finding.severity] for finding in self.findings), default=0)


def lint_paths(
    paths: Iterable[Path | str],
    *,
    env: Mapping[str, str] | None,
    fix: bool = False,
    stdin: str | None = None,
) -> LintReport:
    """Judge files and everything of ours in folders; `-` is the text of `stdin`.

    Without `env` no variable is missed. With `fix` the files are changed where a finding says how.

    Raises:
        ManifestError: The project's lint settings cannot be read.
    """
    judged: dict[str, Judged] = {}
    for given in map(str, paths):
        if given == STDIN:
            judged[given] = _judge(stdin or "", STDIN, None, named=True, env=env, fix=False)
        elif Path(given).is_dir():
            for path in _collect(Path(given)):
                found = _judge_file(path, named=False, env=env, fix=fix)
                if found is not None:
                    judged[str(path)] = found
        else:
            found = _judge_file(Path(given), named=True, env=env, fix=fix)
            if found is not None:
                judged[given] = found
    return LintReport(tuple(_without_repeats(judged)))


def _without_repeats(judged: Mapping[str, Judged]) -> Iterator[Judged]:
    """Yield the files, each finding at one of them only; a file that others extend need not be a job alone."""
    bases = {base for one in judged.values() for base in one.bases}
    said: set[tuple[str, Span | None]] = set()
    settled: dict[str, Judged] = {}
    for file in sorted(judged, key=lambda file: (file not in bases, file)):
        found = judged[file].findings
        kept = [
            finding
            for finding in found
            if (finding.rule, finding.span) not in said and not (file in bases and finding.rule in _OF_WHOLE)
        ]
        said.update((finding.rule, finding.span) for finding in kept)
        settled[file] = replace(judged[file], findings=tuple(kept))
    yield from (settled[file] for file in sorted(settled))


def lint_document(document: Document, *, env: Mapping[str, str] | None, settings: Settings) -> list[Finding]:
    """Return what is wrong with one document, after comments and settings, in the order of the text."""
    kept = list(_heeded(document, list(_raw_findings(document, env))))
    adjusted = [known for finding in kept if (known := settings.apply(finding)) is not None]
    return sorted(
        adjusted, key=lambda finding: (finding.span or Span(document.file, 0, 0, 0, 0), finding.rule)
    )


def _heeded(document: Document, found: list[Finding]) -> Iterator[Finding]:
    """Apply the comments of each file to what is found in it; what lies in another file is not mended from here."""
    own = [finding for finding in found if finding.span is None or finding.span.file == document.file]
    yield from apply_ignores(own, ignores_in(document.text, file=document.file), NAMES)
    for file in {finding.span.file for finding in found if finding.span} - {document.file}:
        theirs = [finding for finding in found if finding.span and finding.span.file == file]
        ignores = ignores_in(read_text(Path(file)), file=file)
        kept = (finding for finding in apply_ignores(theirs, ignores, NAMES) if finding in theirs)
        yield from (replace(finding, fix=None) for finding in kept)


def _raw_findings(document: Document, env: Mapping[str, str] | None) -> Iterator[Finding]:
    if document.kind is Kind.MESSAGE:
        message = read_message(document.text, file=document.file, path=document.path)
        yield from _run_message(message)
        return
    if document.kind is Kind.ADAPTER:
        yield from adapter_findings(document)
        return
    source = load_source(document.text, file=document.file)
    if document.example and source.at((EXTENDS,)) is not None:
        return  # without what it extends there is no telling what is missing
    source = extended(source, folder=document.folder)
    job, findings = read_job(source, folder=document.folder, env=env, file=document.path)
    yield from findings
    if job is not None:
        known = {finding.span for finding in findings}
        yield from (
            finding for finding in _run_job(job, example=document.example) if finding.span not in known
        )


def _run_job(job: Job, *, example: bool) -> Iterator[Finding]:
    for rule in RULES:
        if rule.job is not None and not (example and rule.disk):
            yield from map(rule.finding, rule.job(job))


def _run_message(message: MessageFile) -> Iterator[Finding]:
    for rule in RULES:
        if rule.message is not None:
            yield from map(rule.finding, rule.message(message))


def _collect(folder: Path) -> Iterator[Path]:
    """Yield the files below a folder that may be ours, leaving hidden folders and what is excluded alone."""
    for inside, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        paths = [Path(inside, name) for name in sorted(names) if Path(name).suffix.lower() in _SUFFIXES]
        settings = settings_for(Path(inside)) if paths else Settings()
        yield from (path for path in paths if not path.name.startswith(".") and not settings.excludes(path))


def _judge_file(path: Path, *, named: bool, env: Mapping[str, str] | None, fix: bool) -> Judged | None:
    """Judge a file; None if nothing in it is ours."""
    try:
        text = read_text(path).removeprefix("\ufeff")
    except ManifestError as error:
        return Judged(str(path), "", error.findings) if named else None
    if not any(True for _ in documents_in(text, file=str(path), path=path, folder=path.parent, named=named)):
        return None
    return _judge(text, str(path), path, named=named, env=env, fix=fix)


def _judge(
    text: str, file: str, path: Path | None, *, named: bool, env: Mapping[str, str] | None, fix: bool
) -> Judged:
    folder = Path() if path is None else path.parent
    settings = settings_for(folder)
    judged = Judged(file, text, ())
    for _ in range(_MAX_ROUNDS):
        documents = documents_in(judged.text, file=file, path=path, folder=folder, named=named)
        findings = [
            finding
            for document in documents
            for finding in lint_document(document, env=env, settings=settings)
        ]
        judged = replace(judged, findings=tuple(findings), bases=_bases(judged.text, file, folder))
        mended, made = apply_fixes(judged.text, findings) if fix else (judged.text, 0)
        if not made:
            break
        judged = replace(judged, text=mended, fixed=judged.fixed + made)
    if judged.fixed and path is not None:
        path.write_bytes(judged.text.encode())
    return judged


def _bases(text: str, file: str, folder: Path) -> frozenset[str]:
    if EXTENDS not in text or not file.lower().endswith((".yaml", ".yml")):
        return frozenset()
    return frozenset(str(path) for path, _ in bases_of(load_source(text, file=file), folder=folder))
