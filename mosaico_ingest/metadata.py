"""Metadata of sequences and topics: its validation against JSON Schemas, and its sources in recordings.

Input: jobs and opened recordings. Output: jobs with their final metadata, and findings with locations in the files that
state the metadata. The module depends only on jobs and recordings, so lint, plans and runs share it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from fnmatch import fnmatchcase
from functools import cache
from os.path import normpath, relpath
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from urllib.parse import unquote, urldefrag, urljoin, urlsplit

from msgspec import Struct, field
from msgspec.structs import replace

from mosaico_ingest.display import counted
from mosaico_ingest.documents import read_limited
from mosaico_ingest.errors import ContractError, ManifestError
from mosaico_ingest.findings import Edit, Finding, Severity, Span, join_names, nearest
from mosaico_ingest.job.model import Job, Origin, TopicSettings
from mosaico_ingest.job.validation import key_path_text
from mosaico_ingest.job.values import FileNamePattern, first_match
from mosaico_ingest.job.yaml_source import KeyPath, Source, load_source, resolve_plain
from mosaico_ingest.remote import AnyPath
from mosaico_ingest.rosbag.recording import Recording

if TYPE_CHECKING:
    from jsonschema import FormatChecker
    from jsonschema.protocols import Validator
    from referencing import Registry, Resource

_LITERAL_KEYWORDS = frozenset({"const", "default", "enum", "examples"})
"""Keywords whose values are data, in which `$ref` has no meaning."""
_NAMED_SCHEMAS = frozenset({"properties", "patternProperties", "$defs", "definitions", "dependentSchemas"})
"""Keywords whose keys are names, not keywords."""
_MAX_MESSAGE = 200
_MAX_CHOICES = 12
_TYPES = {
    "string": "text", "integer": "a whole number", "number": "a number", "boolean": "true or false",
    "object": "a mapping", "array": "a list", "null": "null",
}  # fmt: skip


_SECTION = ("sequence", "metadata")
_REFUSED = re.compile(r"[^A-Za-z0-9 _-]+|-(?=-)")
"""Characters that the platform rejects in metadata keys."""


def check_metadata_contracts(job: Job, topics: Iterable[str]) -> None:
    """Validate the metadata of a job's sequence and of these topics against their schemas.

    Raises:
        ContractError: The metadata violates a schema; `findings` has every violation.
        ManifestError: A schema is invalid.
    """
    spans = Spans(job.origin.spans, job.origin.key_spans)
    findings: list[Finding] = []
    if job.sequence.metadata_schema is not None:
        schema = load_schema(Path(job.sequence.metadata_schema))
        findings += violations(schema, job.sequence.metadata, ("sequence", "metadata"), spans)
    for topic in topics:
        settings = job.settings_of(topic)
        if settings.metadata_schema is not None:
            schema = load_schema(Path(settings.metadata_schema))
            findings += violations(schema, settings.metadata, topic_section(job.topic_settings, topic), spans)
    unique = tuple(dict.fromkeys(findings))
    if unique:
        first = unique[0]
        more = f" (and {counted(len(unique) - 1, 'more violation')})" if len(unique) > 1 else ""
        where = str(first.span) if first.span else job.origin.file
        raise ContractError(f"{first.message}{more}", where=where, hint=first.help, findings=unique)


def topic_section(settings: Mapping[str, TopicSettings], topic: str) -> KeyPath:
    """Return the key path of the metadata that applies to a topic, which exists only if a setting defines it."""

    def defining(key: str) -> str | None:
        return first_match((glob for glob, entry in settings.items() if key in entry.model_fields_set), topic)

    return ("topic_settings", defining("metadata") or defining("metadata_schema") or topic, "metadata")


class MetadataSchema(Struct, frozen=True):
    """A valid JSON Schema with every file that it refers to."""

    path: Path
    validator: Validator
    files: tuple[Path, ...]
    """The schema's file and the files that it refers to, directly or indirectly."""


def load_schema(path: Path) -> MetadataSchema:
    """Read a JSON Schema (draft 2020-12 unless `$schema` names another one) and the files that it refers to.

    References to files are resolved relative to the file, without network access.

    Raises:
        ManifestError: A file cannot be read, is not JSON, is not a valid schema, or refers to a schema that does not exist;
            `findings` has the locations.
    """
    loader = _Loader(path)
    return MetadataSchema(path, loader.load(), tuple(loader.sources))


def schema_files(path: Path) -> tuple[Path, ...]:
    """Return a schema's file and the files that it refers to; only the file itself if it is invalid."""
    try:
        return load_schema(path).files
    except ManifestError:
        return (path,)


class _Loader:
    """Reads a schema's file and the files that it refers to."""

    def __init__(self, path: Path) -> None:
        self._file = Path(normpath(path.absolute()))
        self._relative = not path.is_absolute()
        self._folders: dict[str, Path] = {}
        """Local folders by the URL of the `$id` of a schema inside."""
        self.sources: dict[Path, Source] = {}
        self._findings: list[Finding] = []

    def load(self) -> Validator:
        """Return the validator of the schema after checking all files; raise ManifestError as `load_schema` does."""
        from jsonschema import Draft202012Validator  # noqa: PLC0415 - only manifests with a schema need it
        from jsonschema.validators import validator_for  # noqa: PLC0415 - only manifests with a schema need it
        from jsonschema_specifications import REGISTRY  # noqa: PLC0415 - only manifests with a schema need it
        from referencing import Registry  # noqa: PLC0415 - only manifests with a schema need it

        self._read(self._file)
        registry: Registry[Any] = Registry(retrieve=self._retrieve).combine(REGISTRY)
        checked: set[Path] = set()
        while pending := [file for file in self.sources if file not in checked]:
            for file in pending:
                checked.add(file)
                self._check(file, registry)
        if self._findings:
            raise _refusal(self._findings)
        document: Any = self.sources[self._file].value
        kind = validator_for(document, default=Draft202012Validator)
        reference = {"$ref": self._file.as_uri()}
        return kind(reference, registry=registry, format_checker=_format_checker())

    def _retrieve(self, uri: str) -> Resource[Any]:
        """Return the schema of a URI, which must be that of a local file."""
        from referencing import Resource  # noqa: PLC0415 - only manifests with a schema need it
        from referencing.exceptions import NoSuchResource  # noqa: PLC0415 - only manifests with a schema need it
        from referencing.jsonschema import DRAFT202012  # noqa: PLC0415 - only manifests with a schema need it

        file = self._local_file(uri)
        source = None if file is None else self.sources.get(file) or self._read(file)
        if source is None:
            raise NoSuchResource(ref=uri)
        return Resource.from_contents(source.value, default_specification=DRAFT202012)

    def _local_file(self, uri: str) -> Path | None:
        """Return the file of a `file` URI, or of a URI in the folder of a `$id` of a schema; None for other URIs."""
        parts = urlsplit(uri)
        if parts.scheme == "file":
            return Path(normpath(unquote(parts.path)))
        for base, folder in self._folders.items():
            if uri.startswith(base):
                return Path(normpath(folder / unquote(uri.removeprefix(base))))
        return None

    def _read(self, file: Path) -> Source | None:
        """Read a file; return None if it does not exist, or after a finding if it is not JSON."""
        if not file.is_file() and file != self._file:
            return None
        source = read_json(file, name=self._name(file))
        if isinstance(source, Finding):
            self._findings.append(source)
            return None
        self.sources[file] = source
        identifier = source.value.get("$id") if isinstance(source.value, dict) else None
        if isinstance(identifier, str) and urlsplit(identifier).scheme not in {"", "file"}:
            self._folders.setdefault(urljoin(identifier, "."), file.parent)
        return source

    def _check(self, file: Path, registry: Registry[Any]) -> None:
        """Add findings about the schema in a file and about references that lead nowhere."""
        from jsonschema import Draft202012Validator  # noqa: PLC0415 - only manifests with a schema need it
        from jsonschema.exceptions import best_match  # noqa: PLC0415 - only manifests with a schema need it
        from jsonschema.validators import validator_for  # noqa: PLC0415 - only manifests with a schema need it

        source = self.sources[file]
        document: Any = source.value
        kind = validator_for(document, default=Draft202012Validator)
        violation = best_match(kind(kind.META_SCHEMA).iter_errors(document))
        if violation is not None:
            path = tuple(violation.absolute_path)
            name = ".".join(map(str, path)) or "the document"
            message = f"{name} is not a valid JSON Schema: {violation.message[:_MAX_MESSAGE]}"
            self._add(message, source.span(path), "correct the schema")
            return
        for path, reference, base in _references(source.value, (), file.as_uri()):
            self._check_reference(source.span(path), reference, base, registry)

    def _check_reference(self, span: Span, reference: str, base: str, registry: Registry[Any]) -> None:
        from referencing.exceptions import Unresolvable  # noqa: PLC0415 - only manifests with a schema need it

        count = len(self._findings)
        try:
            registry.resolver(base).lookup(reference)
        except (Unresolvable, RecursionError):
            if len(self._findings) > count:  # the file exists, but is not JSON
                return
            uri, fragment = urldefrag(urljoin(base, reference))
            file = self._local_file(uri)
            if file is None:
                message, hint = f"{reference!r} is not a local file", "copy it, and refer to the copy"
            elif file in self.sources:
                message, hint = f"{self._name(file)} has no schema {fragment!r}", "correct the part after #"
            else:
                message, hint = (
                    f"the file {self._name(file)} does not exist",
                    "correct the path, which starts at this file",
                )
            self._add(f"$ref {reference!r} cannot be resolved: {message}", span, hint)

    def _name(self, file: Path) -> str:
        """Return the name of a file in messages: relative if the schema's path is relative."""
        return relpath(file) if self._relative else str(file)

    def _add(self, message: str, span: Span, hint: str) -> None:
        self._findings.append(Finding("invalid-schema", Severity.ERROR, message, span, hint))


def read_json(file: AnyPath, *, name: str | None = None) -> Source | Finding:
    """Return a JSON or YAML file with the span of each value, or a finding of `invalid-schema` if it cannot be parsed."""
    name = name or str(file)
    start = Span(name, 1, 1, 1, 1)
    try:
        text = read_limited(file).decode().removeprefix("\ufeff")
    except OSError as error:
        return _not_json(f"{name} cannot be read: {(error.strerror or str(error)).lower()}", start)
    except UnicodeDecodeError:
        return _not_json(f"{name} is not UTF-8", start)
    # YAML allows no tabs in the indentation. JSON texts contain none elsewhere, so columns stay the same.
    source = load_source(text.replace("\t", " "), file=name)
    if file.name.lower().endswith((".yaml", ".yml")):
        return replace(source.findings[0], rule="invalid-schema") if source.findings else source
    try:
        return replace(source, value=json.loads(text))
    except json.JSONDecodeError as error:
        span = Span(name, error.lineno, error.colno, error.lineno, error.colno + 1)
        return _not_json(f"{name} is not JSON: {error.msg}", span)
    except (ValueError, RecursionError) as error:
        return _not_json(f"{name} is not JSON: {error}", start)


def _not_json(message: str, span: Span) -> Finding:
    return Finding("invalid-schema", Severity.ERROR, message, span)


def _refusal(findings: Sequence[Finding]) -> ManifestError:
    first = findings[0]
    more = f" (and {counted(len(findings) - 1, 'more mistake')})" if len(findings) > 1 else ""
    return ManifestError(
        f"{first.message}{more}", where=str(first.span), hint=first.help, findings=tuple(findings)
    )


def _references(node: Any, path: KeyPath, base: str) -> Iterator[tuple[KeyPath, str, str]]:  # noqa: ANN401 - any JSON
    """Yield the key path and the text of every `$ref`, with the URI that it is relative to."""
    if isinstance(node, list):
        for position, item in enumerate(node):
            yield from _references(item, (*path, position), base)
    if not isinstance(node, dict):
        return
    has_names = bool(path) and path[-1] in _NAMED_SCHEMAS
    if not has_names and isinstance(node.get("$id"), str):
        base = urljoin(base, node["$id"])
    for key, value in node.items():
        if not has_names and key in {"$ref", "$dynamicRef"} and isinstance(value, str):
            yield (*path, key), value, base
        elif has_names or key not in _LITERAL_KEYWORDS:
            yield from _references(value, (*path, key), base)


@cache
def _format_checker() -> FormatChecker:
    """Return a checker of `format`, with the formats that need no further library."""
    from jsonschema import FormatChecker  # noqa: PLC0415 - only manifests with a schema need it

    checker = FormatChecker()
    checker.checks("date-time", raises=ValueError)(_is_date_time)
    return checker


def _is_date_time(value: object) -> bool:
    if not isinstance(value, str):
        return True
    moment = datetime.fromisoformat(f"{value[:-1]}+00:00" if value[-1:] in {"Z", "z"} else value)
    return moment.tzinfo is not None


class Spans(Struct, frozen=True):
    """The spans of the values and keys of a manifest, by key path."""

    values: Mapping[KeyPath, Span]
    keys: Mapping[KeyPath, Span]

    def value(self, path: KeyPath) -> Span | None:
        """Return the span of a value, or of the nearest key or value around it."""
        return self.values.get(path) or self._above(path)

    def key(self, path: KeyPath) -> Span | None:
        """Return the span of a key, or of the nearest key or value around it."""
        return self.keys.get(path) or self._above(path)

    def _above(self, path: KeyPath) -> Span | None:
        around = (path[:length] for length in range(len(path), -1, -1))
        spans = (self.keys.get(key_path) or self.values.get(key_path) for key_path in around)
        return next(filter(None, spans), None)


class Violation(Struct, frozen=True):
    """One violation: the key path of the value, or of the mapping that has a wrong key or lacks a key."""

    path: KeyPath
    message: str
    help: str | None = None
    key: str | None = None
    """The key that the mapping at `path` must not have, or lacks."""
    is_missing: bool = False
    suggestion: str | None = None
    """The property that a misspelled key stands for."""


class _Failure(Struct, frozen=True):
    """A keyword of a schema that a value violates."""

    keyword: str
    limit: Any
    """The value of the keyword in the schema."""
    value: Any
    schema: dict[str, Any]
    message: str


def violations(
    schema: MetadataSchema,
    metadata: Mapping[str, Any],
    section: KeyPath,
    spans: Spans,
    *,
    is_uncertain: Callable[[Violation], bool] = lambda _: False,
) -> list[Finding]:
    """Return a finding for each violation in the metadata of the section at a key path, in the order of the text.

    The span is that of the value, or of the key of a mapping that lacks a property. Violations that `is_uncertain` accepts
    are not reported.
    """
    problems = [one for one in _problems(schema, metadata, section) if not is_uncertain(one)]
    meant = {(problem.path, problem.suggestion) for problem in problems if problem.suggestion}
    remaining = [one for one in problems if not (one.is_missing and (one.path, one.key) in meant)]
    findings = [_finding(problem, spans) for problem in remaining]
    start = Span("", 0, 0, 0, 0)
    return sorted(dict.fromkeys(findings), key=lambda finding: finding.span or start)


def with_required_types(schema: MetadataSchema, texts: Mapping[str, str]) -> dict[str, Any]:
    """Return texts with the types that the schema requires.

    A text that the schema rejects becomes its value in YAML without quotes, if the schema accepts this value.
    """

    def wrong_keys(values: Mapping[str, Any]) -> set[str]:
        try:
            errors = list(schema.validator.iter_errors(values))
        except RecursionError:  # `violations` reports the cycle
            return set()
        return {str(error.absolute_path[0]) for error in errors if error.absolute_path}

    values = {key: resolve_plain(texts[key])[0] for key in wrong_keys(texts)}
    refused = wrong_keys(values)
    return {**texts, **{key: value for key, value in values.items() if key not in refused}}


def _finding(problem: Violation, spans: Spans) -> Finding:
    fix = None
    if problem.key is None:
        span = spans.value(problem.path)
    elif problem.is_missing:
        span = spans.key(problem.path)
    else:
        path = (*problem.path, problem.key)
        span = spans.key(path)
        if path in spans.keys and _same_letters(problem.key, problem.suggestion):
            fix = Edit(spans.keys[path], problem.suggestion or "")
    return Finding("metadata-schema", Severity.ERROR, problem.message, span, problem.help, fix)


def _same_letters(key: str, suggestion: str | None) -> bool:
    def plain(word: str) -> str:
        return "".join(character for character in word.lower() if character not in "-_ ")

    return suggestion is not None and plain(key) == plain(suggestion)


def _problems(schema: MetadataSchema, metadata: Mapping[str, Any], section: KeyPath) -> Iterator[Violation]:
    from jsonschema.exceptions import best_match  # noqa: PLC0415 - slow to import, and few manifests have a schema

    try:
        for error in schema.validator.iter_errors(metadata):
            cause = best_match([error]) or error  # the most specific one of the alternatives of `anyOf`
            node = cast("Any", cause.schema)
            failure = _Failure(
                keyword=str(cause.validator),
                limit=cause.validator_value,
                value=cause.instance,
                schema=node if isinstance(node, dict) else {},
                message=cause.message,
            )
            yield from _DESCRIBERS.get(failure.keyword, _other)(failure, (*section, *cause.absolute_path))
    except RecursionError:
        message = f"{key_path_text(section)} cannot be validated, because {schema.path} refers to itself without end"
        yield Violation(section, message, "remove the cycle of $ref")


def _missing(failure: _Failure, path: KeyPath) -> Iterator[Violation]:
    """Yield a violation for the required property that a failure is about."""
    for name in failure.limit:
        if name not in failure.value and failure.message.startswith(repr(name)):
            message = f"{key_path_text(path)} lacks {name!r}, which {_name_of(failure)} requires"
            yield Violation(path, message, _about(failure, name) or f"add {name}:", name, is_missing=True)


def _additional(failure: _Failure, path: KeyPath) -> Iterator[Violation]:
    """Yield a violation for each key that the schema does not allow."""
    properties = failure.schema.get("properties", {})
    if failure.limit is not False:
        yield from _other(failure, path)
        return
    patterns = failure.schema.get("patternProperties", {})
    extra = (key for key in failure.value if key not in properties)
    for key in (key for key in extra if not any(re.search(pattern, key) for pattern in patterns)):
        close = nearest(str(key), [name for name in properties if name not in failure.value])
        allowed = f"allowed: {_choices(properties)}" if properties else "remove it"
        hint = f"did you mean {close!r}? {allowed}" if close else allowed
        message = f"unknown key {key!r} in {key_path_text(path)}"
        yield Violation(path, message, hint, key, suggestion=close)


def _wrong_type(failure: _Failure, path: KeyPath) -> Iterator[Violation]:
    names = [failure.limit] if isinstance(failure.limit, str) else failure.limit
    expected = " or ".join(_TYPES.get(name, str(name)) for name in names)
    yield Violation(
        path, f"{key_path_text(path)} must be {expected}, not {_shown(failure.value)}", _about(failure)
    )


def _not_a_choice(failure: _Failure, path: KeyPath) -> Iterator[Violation]:
    choices = failure.limit if failure.keyword == "enum" else [failure.limit]
    words = [choice for choice in choices if isinstance(choice, str)]
    close = nearest(failure.value, words) if isinstance(failure.value, str) else None
    hint = f"allowed: {_choices(choices)}"
    hint = f"did you mean {close!r}? {hint}" if close else hint
    yield Violation(path, f"{key_path_text(path)} cannot be {_shown(failure.value)}", hint)


def _pattern(failure: _Failure, path: KeyPath) -> Iterator[Violation]:
    message = f"{key_path_text(path)} is {_shown(failure.value)}, which does not match {failure.limit!r}"
    yield Violation(path, message, _about(failure))


def _other(failure: _Failure, path: KeyPath) -> Iterator[Violation]:
    message = f"{key_path_text(path)}: {failure.message[:_MAX_MESSAGE]} ({failure.keyword})"
    yield Violation(path, message, _about(failure))


_DESCRIBERS: dict[str, Callable[[_Failure, KeyPath], Iterator[Violation]]] = {
    "required": _missing,
    "additionalProperties": _additional,
    "type": _wrong_type,
    "enum": _not_a_choice,
    "const": _not_a_choice,
    "pattern": _pattern,
}


def _about(failure: _Failure, name: str | None = None) -> str | None:
    """Return a hint from the description of the property that a failure is about."""
    schema = failure.schema
    node = schema.get("properties", {}).get(name, {}) if name is not None else schema
    text = node.get("description") if isinstance(node, dict) else None
    return f"follow its description: {text}" if isinstance(text, str) and text else None


def _name_of(failure: _Failure) -> str:
    title = failure.schema.get("title")
    return f"the schema {title!r}" if isinstance(title, str) else "the schema"


def _choices(values: Iterable[object]) -> str:
    texts = [str(value) for value in values]
    more = f" and {len(texts) - _MAX_CHOICES} more" if len(texts) > _MAX_CHOICES else ""
    return f"{', '.join(texts[:_MAX_CHOICES])}{more}"


def _shown(value: object) -> str:
    if isinstance(value, bool) or value is None:
        return str(value).lower() if value is not None else "null"
    if isinstance(value, int | float):
        return f"the number {value}"
    if isinstance(value, str):
        return f"the text {value[:_MAX_MESSAGE]!r}"
    return "a list" if isinstance(value, list) else "a mapping"


class _Addition(Struct, frozen=True):
    """The metadata of one source, or the reason why the source has none."""

    source: str
    """The source in words, such as `the file name`."""
    span: Span | None
    """The span of the source in the manifest."""
    values: Mapping[str, Any] = {}
    problem: str | None = None
    hint: str | None = None
    file: Source | None = None
    """The side-car file that contains the values."""


class _Merged(Struct):
    values: dict[str, Any] = field(default_factory=dict[str, Any])
    owners: dict[str, _Addition] = field(default_factory=dict[str, _Addition])
    findings: list[Finding] = field(default_factory=list[Finding])


def fill_in_metadata(job: Job, recording: Recording) -> tuple[Job, tuple[Finding, ...]]:
    """Return the job with the final metadata of its sequence, and findings about sources without a match.

    Raises:
        ManifestError: A side-car file is not a JSON object, or the platform refuses the metadata.
        BagError: The recording cannot be read.
    """
    if job.sequence.metadata_from is None:
        return job, ()
    merged = _Merged()
    for addition in _additions(job, recording):
        _merge(merged, addition)
    spans, key_spans = dict[KeyPath, Span](), dict[KeyPath, Span]()
    for key, owner in merged.owners.items():
        if owner.file is not None:
            values, keys = source_spans(owner.file, key)
            spans.update(values)
            key_spans.update(keys)
        elif owner.span is not None:
            path = (*_SECTION, key)
            spans[path] = key_spans[path] = owner.span
    metadata = {**merged.values, **job.sequence.metadata}
    completed = job.replace(
        sequence=job.sequence.replace(metadata=metadata),
        origin=with_spans(job.origin, spans, key_spans),
    )
    return completed.check(), tuple(merged.findings)


def source_spans(source: Source, key: str) -> tuple[dict[KeyPath, Span], dict[KeyPath, Span]]:
    """Return the spans of the values and keys below a top-level key of a JSON file, as key paths of the metadata."""

    def below(spans: Mapping[KeyPath, Span]) -> dict[KeyPath, Span]:
        return {(*_SECTION, *path): span for path, span in spans.items() if path[:1] == (key,)}

    return below(source.spans), below(source.key_spans)


def with_spans(origin: Origin, spans: Mapping[KeyPath, Span], key_spans: Mapping[KeyPath, Span]) -> Origin:
    """Return an origin with further spans; those of the manifest take precedence."""
    return replace(origin, spans={**spans, **origin.spans}, key_spans={**key_spans, **origin.key_spans})


def _merge(merged: _Merged, addition: _Addition) -> None:
    """Add the values of a source, which take precedence over those of earlier sources."""
    if addition.problem is not None:
        merged.findings.append(
            Finding("metadata-source", Severity.WARNING, addition.problem, addition.span, addition.hint)
        )
    for key, value in addition.values.items():
        if key in merged.values and merged.values[key] != value:
            merged.findings.append(_conflict(key, merged, addition))
        merged.values[key] = value
        merged.owners[key] = addition


def _conflict(key: str, merged: _Merged, addition: _Addition) -> Finding:
    before, after = merged.values[key], addition.values[key]
    return Finding(
        "metadata-conflict",
        Severity.WARNING,
        f"{key} is {before!r} in {merged.owners[key].source} and {after!r} in {addition.source};"
        f" {addition.source} takes precedence",
        addition.span,
        "correct the wrong source, or set the key in sequence.metadata",
    )


def _additions(job: Job, recording: Recording) -> Iterator[_Addition]:
    """Yield the metadata of each source, in ascending order of precedence."""
    sources = job.sequence.metadata_from
    if sources is None:
        return
    path = job.main_path
    if sources.records:
        yield from _record_additions(job, sources.records, recording)
    if sources.custom_data:
        yield _custom_data(job, recording)
    if sources.file_name is not None:
        yield _file_name(job, sources.file_name, path)
    sidecar = job.sidecar
    if sidecar is not None:
        yield _sidecar(job, sidecar)


def _span(job: Job, *path: str | int) -> Span | None:
    return job.value_span("sequence", "metadata_from", *path) or job.span("sequence", "metadata_from", *path)


def _record_additions(job: Job, patterns: Sequence[str], recording: Recording) -> Iterator[_Addition]:
    records = recording.metadata_records()
    for position, pattern in enumerate(patterns):
        span = _span(job, "records", position)
        names = [name for name in records if fnmatchcase(name, pattern)]
        if not names:
            problem = f"no metadata record matches {pattern!r}"
            close = nearest(pattern, records)
            hint = (
                f"the recording has {join_names(records)}"
                if records
                else "the recording has no metadata records"
            )
            hint = f"did you mean {close!r}? {hint}" if close else hint
            yield _Addition("the metadata records", span, problem=problem, hint=hint)
        for name in names:
            yield _Addition(f"the metadata record {name!r}", span, _values(job, records[name]))


def _custom_data(job: Job, recording: Recording) -> _Addition:
    span, data = _span(job, "custom_data"), recording.custom_data()
    if data:
        return _Addition("custom_data", span, _values(job, data))
    return _Addition(
        "custom_data",
        span,
        problem="the recording has no custom_data",
        hint="record with `ros2 bag record --custom-data KEY=VALUE`, or remove the key",
    )


def _values(job: Job, texts: Mapping[str, str]) -> dict[str, Any]:
    """Return the texts of a source with the types that the metadata schema requires.

    `_` replaces characters that the platform rejects in keys, and empty keys are dropped.
    """
    texts_by_key = {name: text for key, text in texts.items() if (name := _REFUSED.sub("_", key))}
    path = job.sequence.metadata_schema
    return (
        with_required_types(load_schema(Path(path)), texts_by_key) if path is not None else dict(texts_by_key)
    )


def _file_name(job: Job, pattern: FileNamePattern, path: AnyPath) -> _Addition:
    names = [path.name]
    for _ in range(1, pattern.depth):
        path = path.parent
        names.insert(0, path.name)
    name, span = "/".join(names), _span(job, "file_name")
    values = pattern.match(name)
    if values is not None:
        return _Addition("the file name", span, values)
    return _Addition(
        "the file name",
        span,
        problem=f"the file name {name!r} does not match {pattern.text!r}",
        hint="rename the recording, or correct the pattern",
    )


def _sidecar(job: Job, file: AnyPath) -> _Addition:
    """Return the content of the side-car file; a file that is not a JSON object ends the plan."""
    span = _span(job, "sidecar")
    if not file.is_file():
        problem = f"the side-car file {file} does not exist"
        return _Addition("the side-car file", span, problem=problem, hint="add the file, or remove the key")
    source = read_json(file)
    if isinstance(source, Finding):
        raise _refusal([replace(source, rule="invalid-sidecar")])
    if not isinstance(source.value, dict):
        message = f"{file} has no JSON object"
        hint = 'write {"key": "value"}'
        raise _refusal([Finding("invalid-sidecar", Severity.ERROR, message, source.span(()), hint)])
    values = {str(key): value for key, value in source.value.items()}
    return _Addition("the side-car file", span, values, file=source)
