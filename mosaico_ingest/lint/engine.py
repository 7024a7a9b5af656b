"""The lint engine: read documents, run the rules, apply comments and settings, and count findings."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cache, partial
from itertools import takewhile
from pathlib import Path

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.bridge import AdapterFinder
from mosaico_ingest.adapters.mapping.loader import MappingSpec, load_adapter
from mosaico_ingest.adapters.standalone import DefinitionFinder
from mosaico_ingest.errors import AdapterError, BagError, ManifestError
from mosaico_ingest.findings import Edit, Finding, Severity, Span
from mosaico_ingest.job.compose import EXTENDS_KEY as EXTENDS
from mosaico_ingest.job.compose import bases_of, extended
from mosaico_ingest.job.manifest import read_text
from mosaico_ingest.job.yaml_source import load_source
from mosaico_ingest.lint.job import Job, read_job
from mosaico_ingest.lint.message import MessageFile, read_message
from mosaico_ingest.lint.rules import CHECKS
from mosaico_ingest.lint.settings import NAMES, Settings, settings_for
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition

__all__ = [
    "MARKER",
    "STDIN",
    "Document",
    "Ignore",
    "Judged",
    "Kind",
    "LintReport",
    "adapter_findings",
    "apply_fixes",
    "apply_ignores",
    "documents_in",
    "ignores_in",
    "kind_of",
    "lint_document",
    "lint_paths",
]


def apply_fixes(text: str, findings: Iterable[Finding]) -> tuple[str, int]:
    """Return the text with every proposed change that does not touch another one, and how many those are."""
    lines = text.splitlines(keepends=True)
    edits = sorted(
        {finding.fix for finding in findings if finding.fix is not None}, key=lambda edit: edit.span
    )
    made = 0
    untouched = (len(lines) + 1, 0)
    for edit in reversed(edits):
        span = edit.span
        if (span.end_line, span.end_column) <= untouched and span.line == span.end_line <= len(lines):
            lines[span.line - 1] = _edited(lines[span.line - 1], edit)
            untouched = (span.line, span.column)
            made += 1
    return "".join(lines), made


def _edited(line: str, edit: Edit) -> str:
    return line[: edit.span.column - 1] + edit.text + line[edit.span.end_column - 1 :]


MARKER = "# ingest:"
"""What every comment to the linter starts with."""

_COMMENT = re.compile(r"#\s*ingest:\s*(ignore|ignore-file)\s*\[([^\]]*)\]")
_WORD = re.compile(r"[^\s,]+")


@dataclass(slots=True)
class Ignore:
    """One rule that a comment silences, on its line (alone on a line: on the next) or in the whole file."""

    rule: str
    """As written: a code or a name."""
    span: Span
    lines: range
    used: bool = field(default=False)


def ignores_in(text: str, *, file: str) -> list[Ignore]:
    """Return what the comments of a text silence."""
    ignores: list[Ignore] = []
    for number, line in enumerate(text.splitlines(), 1):
        for comment in _COMMENT.finditer(line):
            alone = not line[: comment.start()].strip()
            lines = range(number + alone, number + alone + 1)
            if comment[1] == "ignore-file":
                lines = range(1, text.count("\n") + 2)
            for word in _WORD.finditer(comment[2]):
                start = comment.start(2) + word.start() + 1
                ignores.append(
                    Ignore(word[0], Span(file, number, start, number, start + len(word[0])), lines)
                )
    return ignores


def apply_ignores(
    findings: Iterable[Finding], ignores: Sequence[Ignore], names: dict[str, str]
) -> list[Finding]:
    """Return the findings that no comment silences, and one for each comment that silences nothing.

    `names` maps every code and every name of a rule to its name.
    """
    kept = [finding for finding in findings if not _silenced(finding, ignores, names)]
    kept += [_complaint(ignore, names) for ignore in ignores if not ignore.used]
    return kept


def _silenced(finding: Finding, ignores: Sequence[Ignore], names: dict[str, str]) -> bool:
    line = finding.span.line if finding.span else 0
    about = [item for item in ignores if names.get(item.rule) == finding.rule and line in item.lines]
    for ignore in about:
        ignore.used = True
    return bool(about)


def _complaint(ignore: Ignore, names: dict[str, str]) -> Finding:
    if ignore.rule in names:
        message = f"nothing here breaks {ignore.rule}"
        return Finding("unused-ignore", Severity.WARNING, message, ignore.span, "remove it from the comment")
    message = f"there is no rule {ignore.rule!r}"
    return Finding("unknown-rule", Severity.WARNING, message, ignore.span, "see `ingest lint --explain all`")


_JOB = re.compile(r"^(bag|\"bag\"|'bag'|extends) *:|^ *\{ *\"?(bag|extends)\"? *:", re.MULTILINE)
_ADAPTER = re.compile(r"^(adapter|ros_type|variants) *:", re.MULTILINE)
_NAMED = re.compile(r"^adapter *:", re.MULTILINE)
_FENCE = re.compile(r"^(?P<indent> *)(?P<fence>```+|~~~+) *(?P<language>\w*)[^\n]*$")


class Kind(str, Enum):
    """What a text is judged as."""

    JOB = "job"
    ADAPTER = "adapter"
    MESSAGE = "message"


class Document(Struct, frozen=True):
    """A text to judge."""

    file: str
    """The name to show."""
    text: str
    kind: Kind
    folder: Path
    """Where its relative paths start."""
    path: Path | None = None
    """The file on disk, if it is one of its own."""
    example: bool = False
    """Whether it is an example on a page, so that nothing beside it has to be there."""


def kind_of(text: str, *, suffix: str = ".yaml") -> Kind | None:
    """Return what a text looks like; None if it is neither a job nor an adapter nor a definition."""
    if suffix == ".msg":
        return Kind.MESSAGE
    if _JOB.search(text):
        return Kind.JOB
    return Kind.ADAPTER if _ADAPTER.search(text) else None


def documents_in(text: str, *, file: str, path: Path | None, folder: Path, named: bool) -> Iterator[Document]:
    """Yield what a file holds: itself, or the YAML blocks of a Markdown page that are jobs or adapters.

    A file that was `named` is a job unless it looks like something else.
    """
    suffix = Path(file).suffix.lower()
    if suffix in {".md", ".markdown"}:
        for block in _blocks(text):
            kind = kind_of(block)
            whole = kind is not Kind.ADAPTER or _NAMED.search(block) is not None
            if kind is not None and whole and f"{MARKER} skip" not in block:
                yield Document(file, block, kind, folder, example=True)
        return
    kind = kind_of(text, suffix=suffix) or (Kind.JOB if named else None)
    if kind is not None:
        yield Document(file, text, kind, folder, path)


def _blocks(text: str) -> Iterator[str]:
    """Yield the YAML blocks of a Markdown text, each below as many empty lines as there are above it."""
    lines = iter(enumerate(text.splitlines()))
    for number, line in lines:
        opening = _FENCE.match(line)
        if opening is None:
            continue
        inside = takewhile(partial(_is_inside, opening["fence"]), lines)
        block = [inner for _, inner in inside]
        if opening["language"].lower() in {"yaml", "yml"}:
            yield "\n" * (number + 1) + "\n".join(block) + "\n"


def _is_inside(fence: str, numbered: tuple[int, str]) -> bool:
    return numbered[1].strip() != fence


def adapter_findings(document: Document) -> Iterator[Finding]:
    """Yield what is wrong with an adapter file, once for each place."""
    try:
        spec = load_adapter(document.text, file=document.file, adapters=AdapterFinder(document.folder))
    except AdapterError as error:
        start = Span(document.file, 1, 1, 1, 1)
        yield from error.findings or [Finding("adapter-file", Severity.ERROR, error.what, start, error.hint)]
        return
    said: set[Span | None] = set()
    for msgtype in spec.ros_types:
        definition = _definition(spec, msgtype)
        found = () if definition is None else spec.check(definition, ros_shape(definition))
        for finding in found:
            if finding.span not in said:
                said.add(finding.span)
                yield finding


def _definition(spec: MappingSpec, msgtype: str) -> Definition | None:
    """Return the definition in the file itself, or else that of a distro; None where there is none."""
    try:
        return _known_types().find(msgtype, spec)
    except BagError:
        return None


@cache
def _known_types() -> DefinitionFinder:
    return DefinitionFinder()


STDIN = "-"
_SUFFIXES = (".yaml", ".yml", ".msg", ".md", ".markdown")
_MAX_ROUNDS = 10
_OF_WHOLE = frozenset({"missing-key", "unset-variable"})
"""Rules about what only a whole job must have."""
_EXIT_CODES = {Severity.INFO: 10, Severity.WARNING: 11, Severity.ERROR: 12}


class Judged(Struct, frozen=True):
    """A file with what was found in it."""

    file: str
    text: str
    findings: tuple[Finding, ...]
    fixed: int = 0
    """How many changes were made."""
    bases: frozenset[str] = frozenset()
    """The files it extends."""


class LintReport(Struct, frozen=True):
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
    for check in CHECKS:
        if check.job is not None and not (example and check.reads_files):
            yield from map(check.finding, check.job(job))


def _run_message(message: MessageFile) -> Iterator[Finding]:
    for check in CHECKS:
        if check.message is not None:
            yield from map(check.finding, check.message(message))


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
