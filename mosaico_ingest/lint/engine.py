"""The lint engine: collect files, run the checks, apply comments, settings and fixes, and build the report."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from os.path import normpath
from pathlib import Path

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.bridge import AdapterFinder, ROSBridge, outputs_of
from mosaico_ingest.adapters.mapping.loader import MappingSpec, load_adapter
from mosaico_ingest.adapters.standalone import DefinitionFinder
from mosaico_ingest.contracts.rows import (
    Rows,
    bind_expression,
    locator,
    message_rows,
    ontology_rows,
    syntax_findings,
    type_findings,
)
from mosaico_ingest.documents import read_limited
from mosaico_ingest.errors import AdapterError, BagError, ManifestError
from mosaico_ingest.findings import Edit, Finding, Severity, Span, mask_credentials
from mosaico_ingest.job.expect import AllowedNames, Expectations, TopicExpectations
from mosaico_ingest.job.manifest import EXTENDS_KEY, bases_of, extended, read_text
from mosaico_ingest.job.yaml_source import load_source
from mosaico_ingest.lint.check import Job, MessageFile, read_job, read_message
from mosaico_ingest.lint.documents import Document, Kind, documents_in, files_below, looks_like_ours
from mosaico_ingest.lint.rules import CHECKS
from mosaico_ingest.lint.settings import Settings, apply_ignores, ignores_in, settings_for
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition
from mosaico_ingest.rosbag.definitions.registry import TypeResolver, definition_files

STDIN = "-"
"""The path that stands for the text of `stdin`."""

_MESSAGE_FOLDER_LEVELS = 2
_MAX_FIX_ROUNDS = 10
_RULES_OF_COMPLETE_JOBS = frozenset({"missing-key", "unset-variable"})
"""Rules that do not apply to a file that other manifests extend, because it need not be a complete job."""
_EXIT_CODES = {Severity.INFO: 10, Severity.WARNING: 11, Severity.ERROR: 12}


class LintedFile(Struct, frozen=True):
    """A file with its findings."""

    file: str
    text: str
    findings: tuple[Finding, ...]
    fixed: int = 0
    """Number of fixes that were applied."""
    bases: frozenset[str] = frozenset()
    """The files that this file extends."""


class SkippedFile(Struct, frozen=True):
    """A YAML or JSON file in a linted folder that lint did not check."""

    file: str
    reason: str


class LintReport(Struct, frozen=True):
    """The linted and the skipped files, each in the order of their paths."""

    files: tuple[LintedFile, ...]
    skipped: tuple[SkippedFile, ...] = ()

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All findings, by file, line and column."""
        return tuple(finding for linted in self.files for finding in linted.findings)

    @property
    def exit_code(self) -> int:
        """The exit code: 0 without findings, 3 without files, 10 for infos, 11 for warnings, 12 for errors."""
        if not self.files:
            return 3
        return max((_EXIT_CODES[finding.severity] for finding in self.findings), default=0)


def lint_paths(
    paths: Iterable[Path | str], *, env: Mapping[str, str] | None, fix: bool = False, stdin: str | None = None
) -> LintReport:
    """Check files and the manifests, adapters and message definitions in folders.

    Args:
        paths: Files and folders; `-` stands for the text in `stdin`.
        env: The environment variables. If None, unset variables are not reported.
        fix: Whether to apply the fixes of findings to the files.
        stdin: The text of standard input.

    Raises:
        ManifestError: The lint settings of the project cannot be read.
    """
    linted: dict[str, LintedFile] = {}
    skipped: dict[str, SkippedFile] = {}
    for argument in map(str, paths):
        if argument == STDIN:
            linted[STDIN] = _lint_text(stdin or "", STDIN, None, named=True, env=env, fix=False)
            continue
        named = not Path(argument).is_dir()
        for path in [Path(argument)] if named else files_below(Path(argument), _is_excluded):
            result = _lint_file(path, named=named, env=env, fix=fix)
            if isinstance(result, LintedFile):
                linted[str(path)] = result
            elif result is not None:
                skipped[str(path)] = result
    skips = tuple(skipped[file] for file in sorted(skipped) if file not in linted)
    return LintReport(tuple(_deduplicated(linted)), skips)


def lint_document(document: Document, *, env: Mapping[str, str] | None, settings: Settings) -> list[Finding]:
    """Return the findings of one document in text order, after comments and settings are applied."""
    findings = _apply_comments(document, list(_unfiltered_findings(document, env)))
    adjusted = [_masked(kept) for finding in findings if (kept := settings.apply(finding)) is not None]
    start = Span(document.file, 0, 0, 0, 0)
    return sorted(adjusted, key=lambda finding: (finding.span or start, finding.rule))


def _masked(finding: Finding) -> Finding:
    hint = None if finding.help is None else mask_credentials(finding.help)
    return replace(finding, message=mask_credentials(finding.message), help=hint)


def adapter_findings(document: Document) -> Iterator[Finding]:
    """Yield the findings of an adapter file, one for each location."""
    try:
        spec = load_adapter(document.text, file=document.file, adapters=AdapterFinder(document.folder))
    except AdapterError as error:
        start = Span(document.file, 1, 1, 1, 1)
        yield from error.findings or [Finding("adapter-file", Severity.ERROR, error.what, start, error.hint)]
        return
    spans = set[Span | None]()
    definitions = [_definition(spec, msgtype, document.folder) for msgtype in spec.ros_types]
    for definition in filter(None, definitions):
        for finding in spec.check(definition, ros_shape(definition)):
            if finding.span not in spans:
                spans.add(finding.span)
                yield finding
    if not any(definitions) and not document.example:
        message = (
            f"the fields were not checked, because no definition of {', '.join(spec.ros_types)} is known"
        )
        hint = "put the .msg text under `definition`, or run `ingest adapters test --msg-dir DIR`"
        if not any("/" in msgtype for msgtype in spec.ros_types):
            hint = "run `ingest plan` with a recording that contains the type"
        location = spec.source.span(("variants",) if spec.model.variants else ("ros_type",))
        yield Finding("unchecked-adapter", Severity.INFO, message, location, hint)


def _is_excluded(path: Path) -> bool:
    return settings_for(path.parent).excludes(path)


def _lint_file(
    path: Path, *, named: bool, env: Mapping[str, str] | None, fix: bool
) -> LintedFile | SkippedFile | None:
    """Check a file. Return None for a Markdown page without documents."""
    suffix = path.suffix.lower()
    try:
        text = read_text(path).removeprefix("\ufeff")
    except ManifestError as error:
        if named or _is_ours_in_another_encoding(path, suffix):
            return LintedFile(str(path), "", error.findings)
        return SkippedFile(str(path), error.findings[0].message if error.findings else error.what)
    documents = documents_in(text, file=str(path), path=path, folder=path.parent, named=named)
    if any(True for _ in documents):
        return _lint_text(text, str(path), path, named=named, env=env, fix=fix)
    if suffix in {".md", ".markdown"}:
        return None
    return SkippedFile(str(path), "not a manifest or an adapter")


def _is_ours_in_another_encoding(path: Path, suffix: str) -> bool:
    try:
        return looks_like_ours(read_limited(path), suffix)
    except OSError:
        return False


def _lint_text(
    text: str, file: str, path: Path | None, *, named: bool, env: Mapping[str, str] | None, fix: bool
) -> LintedFile:
    """Check a text. With `fix`, apply fixes until none is left, and write the file."""
    folder = Path() if path is None else path.parent
    settings = settings_for(folder)
    linted = LintedFile(file, text, ())
    for _ in range(_MAX_FIX_ROUNDS):
        documents = documents_in(linted.text, file=file, path=path, folder=folder, named=named)
        findings = [
            finding
            for document in documents
            for finding in lint_document(document, env=env, settings=settings)
        ]
        linted = replace(linted, findings=tuple(findings), bases=_bases(linted.text, file, folder))
        fixed_text, count = _apply_fixes(linted.text, findings) if fix else (linted.text, 0)
        if not count:
            break
        linted = replace(linted, text=fixed_text, fixed=linted.fixed + count)
    if linted.fixed and path is not None:
        path.write_bytes(linted.text.encode())
    return linted


def _bases(text: str, file: str, folder: Path) -> frozenset[str]:
    if EXTENDS_KEY not in text or Path(file).suffix.lower() not in {".yaml", ".yml", ".json"}:
        return frozenset()
    return frozenset(str(path) for path, _ in bases_of(load_source(text, file=file), folder=folder))


def _deduplicated(linted: Mapping[str, LintedFile]) -> Iterator[LintedFile]:
    """Yield the files, each finding in only one of them.

    A mistake in a file that several manifests extend is found once for each of them, and reported in the file itself if
    that is linted too.
    """
    bases = {base for item in linted.values() for base in item.bases}
    reported = set[tuple[str, Span | None]]()
    result: dict[str, LintedFile] = {}
    own_first = sorted(linted, key=lambda file: (file not in bases, Path(file).suffix != ".msg", file))
    for file in own_first:
        findings = [
            finding
            for finding in linted[file].findings
            if (finding.rule, finding.span) not in reported
            and not (file in bases and finding.rule in _RULES_OF_COMPLETE_JOBS)
        ]
        reported.update((finding.rule, finding.span) for finding in findings)
        result[file] = replace(linted[file], findings=tuple(findings))
    yield from (result[file] for file in sorted(result))


def _apply_comments(document: Document, findings: list[Finding]) -> Iterator[Finding]:
    """Apply the comments of each file to the findings in it. Fixes apply only to the document's own file."""
    own = [finding for finding in findings if finding.span is None or finding.span.file == document.file]
    yield from apply_ignores(own, ignores_in(document.text, file=document.file))
    for file in sorted({finding.span.file for finding in findings if finding.span} - {document.file}):
        others = [finding for finding in findings if finding.span and finding.span.file == file]
        ignores = ignores_in(read_text(Path(file)), file=file)
        remaining = (finding for finding in apply_ignores(others, ignores) if finding in others)
        yield from (replace(finding, fix=None) for finding in remaining)


def _unfiltered_findings(document: Document, env: Mapping[str, str] | None) -> Iterator[Finding]:
    if document.kind is Kind.MESSAGE:
        yield from _message_findings(read_message(document.text, file=document.file, path=document.path))
    elif document.kind is Kind.ADAPTER:
        yield from adapter_findings(document)
    else:
        yield from _job_findings(document, env)


def _job_findings(document: Document, env: Mapping[str, str] | None) -> Iterator[Finding]:
    source = load_source(document.text, file=document.file)
    if document.example and source.at((EXTENDS_KEY,)) is not None:
        return  # The base of an example does not exist, so lint cannot know which keys are missing.
    source = extended(source, folder=document.folder)
    job, findings = read_job(source, folder=document.folder, env=env, file=document.path)
    yield from findings
    if job is not None:
        spans = {finding.span for finding in findings}
        yield from (item for item in _check_job(job, example=document.example) if item.span not in spans)
        yield from expectation_findings(job)
        yield from condition_findings(job)
        if not document.example:
            yield from _definition_findings(job)


def _check_job(job: Job, *, example: bool) -> Iterator[Finding]:
    for check in CHECKS:
        if check.job is not None and not (example and check.reads_files):
            yield from map(check.finding, check.job(job))


def _definition_findings(job: Job) -> Iterator[Finding]:
    """Yield the errors in the `.msg` files of `custom_msgs`."""
    for custom in job.manifest.bag.custom_msgs:
        files = definition_files(job.resolve(custom.path)) if job.is_expanded(custom.path) else []
        for file in files:
            path = Path(normpath(file))
            if path.suffix == ".msg":
                findings = _message_findings(_message_in(path))
                yield from (finding for finding in findings if finding.severity is Severity.ERROR)


def _message_in(path: Path) -> MessageFile:
    try:
        return read_message(read_text(path).removeprefix("\ufeff"), file=str(path), path=path)
    except ManifestError:
        return MessageFile(str(path), "", ())


def _message_findings(message: MessageFile) -> Iterator[Finding]:
    for check in CHECKS:
        if check.message is not None:
            yield from map(check.finding, check.message(message))


def _definition(spec: MappingSpec, msgtype: str, folder: Path) -> Definition | None:
    """Return the definition in the adapter file, in a folder near it, or of a distribution, else None."""
    try:
        return _definition_finder(_message_folders(msgtype.partition("/")[0], folder)).find(msgtype, spec)
    except BagError:
        return None


def _message_folders(package: str, folder: Path) -> tuple[tuple[str, Path], ...]:
    """Return the folders of a package's `.msg` files: `PACKAGE` next to an adapter or up to two levels above it."""
    folder = folder.resolve()
    above = [folder, *folder.parents][: _MESSAGE_FOLDER_LEVELS + 1]
    folders = (path for start in above for path in (start / package, *sorted(start.glob(f"*/{package}"))))
    return next((((package, path),) for path in folders if any(path.glob("**/*.msg"))), ())


@cache
def _definition_finder(folders: tuple[tuple[str, Path], ...]) -> DefinitionFinder:
    return DefinitionFinder(custom=[(package, path, None) for package, path in folders])


def _apply_fixes(text: str, findings: Iterable[Finding]) -> tuple[str, int]:
    """Return the text with the fixes of the findings applied, and their number. Of overlapping fixes, apply the last."""
    lines = text.splitlines(keepends=True)
    edits = sorted({finding.fix for finding in findings if finding.fix}, key=lambda edit: edit.span)
    count = 0
    applied = (len(lines) + 1, 0)
    for edit in reversed(edits):
        span = edit.span
        if (span.end_line, span.end_column) <= applied and span.line == span.end_line <= len(lines):
            lines[span.line - 1] = _edited(lines[span.line - 1], edit)
            applied = (span.line, span.column)
            count += 1
    return "".join(lines), count


def _edited(line: str, edit: Edit) -> str:
    return line[: edit.span.column - 1] + edit.text + line[edit.span.end_column - 1 :]


def expectation_findings(job: Job) -> Iterator[Finding]:
    """Yield the mistakes of all expressions.

    Names are checked against the message type that `type` expects, if its definition is known, and against the columns
    of its ontology type.
    """
    expect = job.manifest.expect
    if expect is None:
        return
    for topic, entry in expect.topics.items():
        for text, expected in entry.fields.items():
            path = ("expect", "topics", topic, "fields", text)
            locate = locator(job.source.key_span(path), text)
            mistakes = syntax_findings(text, locate)
            if not mistakes:
                for message, ontology in _rows(job, expect, topic, entry):
                    expression, mistakes = bind_expression(text, message, ontology, locate)
                    if expression is not None:
                        mistakes = list(type_findings(expression, expected, locate))
                    if mistakes:
                        break
            yield from mistakes


def condition_findings(job: Job) -> Iterator[Finding]:
    """Yield the mistakes of `where` and `on_change` that do not depend on the message type."""
    for topic, settings in job.manifest.topic_settings.items():
        conditions = [] if settings.where is None else [(("where",), settings.where)]
        conditions += [(("on_change", position), text) for position, text in enumerate(settings.on_change)]
        for keys, text in conditions:
            span = job.source.span(("topic_settings", topic, *keys))
            yield from syntax_findings(text, locator(span, text))


def _rows(
    job: Job, expect: Expectations, topic: str, entry: TopicExpectations
) -> Iterator[tuple[Rows | None, Rows | None]]:
    """Yield the message type and the ontology type of each type that a topic is expected to have."""
    expected = entry.type
    if expected is None and (other := expect.entry_of(topic, "type")) is not None:
        expected = expect.topics[other].type
    if expected is None:
        return
    names = expected.one_of if isinstance(expected, AllowedNames) else expected
    resolver = _resolver(job)
    for name in (names,) if isinstance(names, str) else names:
        for version in (2, 1):
            try:
                definition = resolver.resolve(name, None, ros_version=version)
            except BagError:
                continue
            yield _rows_of_type(job, topic, definition)
            break


def _rows_of_type(job: Job, topic: str, definition: Definition) -> tuple[Rows | None, Rows | None]:
    """Return the messages and the ontology rows of a topic; an output of an adapter has only ontology rows."""
    adapters, message = job.manifest.adapters, message_rows(definition)
    try:
        bridge = ROSBridge(overrides=adapters.override, loaded=adapters.load, base_dir=job.folder)
        source, _, name = topic.rpartition("/")
        for output in outputs_of(bridge.resolve(source, definition.root).spec) if source else ():
            if output.output == name:
                return None, ontology_rows(output.bind(definition, message.struct).ontology)
        spec = bridge.resolve(topic, definition.root).spec
        if outputs_of(spec):
            return message, None
        return message, ontology_rows(spec.bind(definition, message.struct).ontology)
    except (AdapterError, BagError, ManifestError):
        return message, None


def _resolver(job: Job) -> TypeResolver:
    bag = job.manifest.bag
    custom = [
        (messages.package, Path(job.resolve(messages.path)), messages.store)
        for messages in bag.custom_msgs
        if job.is_expanded(messages.path)
    ]
    try:
        return TypeResolver(bag.ros_distro, custom)
    except BagError:  # other rules report definitions that cannot be used
        return TypeResolver(bag.ros_distro, [])
