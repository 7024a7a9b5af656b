"""Job manifests: composition with `extends`, `matrix` and variables, loading, and the findings of all mistakes."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from itertools import count, product
from os.path import normpath, relpath
from pathlib import Path
from typing import Any, cast

from msgspec import Struct, field
from msgspec.structs import replace
from pydantic import ValidationError

from mosaico_ingest.containers import RECORDING_NAME
from mosaico_ingest.documents import read_limited
from mosaico_ingest.errors import IngestError, ManifestError
from mosaico_ingest.findings import Finding, Severity, Span
from mosaico_ingest.job.fields import AdapterRef, FilePath, Literally, Section, marked_fields, replace_values
from mosaico_ingest.job.model import MAX_JOBS, Manifest, Origin
from mosaico_ingest.job.validation import explain
from mosaico_ingest.job.yaml_source import KeyPath, Scalar, Source, Value, load_source, member, resolve_plain
from mosaico_ingest.remote import AnyPath, RemotePath, is_url, parse_url

PLACEHOLDERS = ("stem", "name", "parent", "date", "index")

_WIDTH = re.compile(r"0?[0-9]")
_BRACED = re.compile(r"\{([^{}]*)\}")
MATRIX_KEY = "matrix"
_REFERENCE = re.compile(r"\$(?:(\$)|\{([^{}]*)\}|(?=\{))")
_INSIDE = re.compile(r"([A-Za-z_][A-Za-z0-9_]*)(?::(int|float|bool))?(?::([-?])(.*))?", re.DOTALL)
_KINDS: Mapping[str, tuple[re.Pattern[str], Callable[[str], Scalar], str]] = {
    "int": (re.compile(r"[+-]?[0-9]+"), int, "a whole number"),
    "float": (re.compile(r"[+-]?[0-9]+(\.[0-9]+)?([eE][+-]?[0-9]+)?"), float, "a number"),
    "bool": (re.compile(r"[Tt]rue|[Ff]alse"), lambda text: text.lower() == "true", "true or false"),
}
"""The notation, the conversion and the description of the values of each kind of variable."""
EXTENDS_KEY = "extends"
_WITHOUT_MANIFEST = "run `ingest bag RECORDING --name NAME`, or draft a manifest with `ingest init RECORDING`"


class Placeholder(Struct, frozen=True):
    """A placeholder such as `{index:03}` in the characters `start:end` of a name."""

    start: int
    end: int
    name: str
    width: str

    @property
    def known(self) -> bool:
        """True if the placeholder exists and its width is valid; only `index` has a width."""
        return self.name in PLACEHOLDERS and (
            not self.width or (self.name == "index" and _WIDTH.fullmatch(self.width) is not None)
        )


def placeholders_in(template: str) -> Iterator[Placeholder]:
    """Yield every `{…}` in a name, including unknown ones."""
    for match in _BRACED.finditer(template):
        name, _, width = match[1].partition(":")
        yield Placeholder(match.start(), match.end(), name, width)


def combinations(document: Value) -> list[dict[str, str]]:
    """Return the matrix variables of each job of a document; one job without variables if it has no matrix.

    A mapping of lists defines every combination of their values; a list defines one job per item. Values that the model
    refuses are ignored. More than `MAX_JOBS` combinations are treated like a document without a matrix.
    """
    matrix = document.get(MATRIX_KEY) if isinstance(document, dict) else None
    if isinstance(matrix, list):
        cells = [variables(item) for item in matrix[:MAX_JOBS]]
    elif isinstance(matrix, dict):
        axes = {str(name): values for name, values in matrix.items() if isinstance(values, list) and values}
        count = 1
        for values in axes.values():
            count *= len(values)
        products = product(*axes.values()) if axes and count <= MAX_JOBS else ()
        cells = [variables(dict(zip(axes, values, strict=True))) for values in products]
    else:
        cells = []
    return cells or [{}]


def variables(mapping: Value) -> dict[str, str]:
    """Return the variables of a mapping as text; values that are neither text nor numbers are ignored."""
    if not isinstance(mapping, dict):
        return {}
    return {str(name): str(value) for name, value in mapping.items() if isinstance(value, str | int)}


class Filled(Struct):
    """A document whose variables are replaced by their values."""

    value: Value
    findings: list[Finding] = field(default_factory=list[Finding])
    changed: set[KeyPath] = field(default_factory=set[KeyPath])
    """Key paths whose text contained a variable; their values may be secret."""
    unknown: set[KeyPath] = field(default_factory=set[KeyPath])
    """Key paths whose text contains an unset variable; the text is unchanged."""


def fill_in(source: Source, env: Mapping[str, str] | None, cell: Mapping[str, str] | None = None) -> Filled:
    """Replace the variables in every text; without `env`, unset variables are not reported.

    A variable's value is looked up in `cell`, then in the environment, then in the document's `defaults`. `cell` defaults
    to the first job of the document's matrix.
    """
    matrix = source.at((MATRIX_KEY,))
    known_variables = _Variables(
        combinations(source.value)[0] if cell is None else cell,
        env,
        variables(source.at(("defaults",))),
        frozenset(map(str, matrix)) if isinstance(matrix, dict) else frozenset(),
    )
    return _filled(source, known_variables)


def fill_in_cell(source: Source, cell: Mapping[str, str]) -> Filled:
    """Replace only the variables of a matrix; all others stay as written."""
    return _filled(source, _Variables(cell, None, {}, alone=True))


def _filled(source: Source, known: _Variables) -> Filled:
    filled = Filled(None)
    filled.value = _value(source.value, (), source, known, filled)
    return filled


class _Variables(Struct, frozen=True):
    """The values of variables from several sources; the first source that has a value takes precedence."""

    cell: Mapping[str, str]
    env: Mapping[str, str] | None
    """None ignores the environment, and unset variables are not reported."""
    defaults: Mapping[str, str]
    axes: frozenset[str] = frozenset()
    """Variables of the matrix; the model reports axes without values."""
    alone: bool = False
    """True to replace only the variables of `cell` and to keep all others for a later pass."""

    def get(self, name: str) -> str | None:
        if name in self.cell:
            return self.cell[name]
        return (self.env or {}).get(name) or self.defaults.get(name)


def _value(value: Value, path: KeyPath, source: Source, known: _Variables, out: Filled) -> Value:
    if any(field.path == path for field in marked_fields(Manifest, Literally)):
        return value
    if isinstance(value, dict):
        return {key: _value(inner, (*path, key), source, known, out) for key, inner in value.items()}
    if isinstance(value, list):
        return [_value(inner, (*path, index), source, known, out) for index, inner in enumerate(value)]
    if isinstance(value, str) and "$" in value:
        return _typed(_text(value, path, source, known, out), value, path, source, out)
    return value


def _typed(text: str, written: str, path: KeyPath, source: Source, out: Filled) -> Value:
    """Return the value of a text that is written as one variable with a kind, such as `${RUN:int}`, else the text."""
    reference = _REFERENCE.fullmatch(written)
    inside = _INSIDE.fullmatch(reference[2] or "") if reference is not None else None
    if inside is None or inside[2] is None or text == written:
        return text
    notation, convert, description = _KINDS[inside[2]]
    if notation.fullmatch(text):
        return convert(text)
    message = f"{inside[1]} must be {description}, not the text {text!r}"
    hint = f"set {inside[1]} to {description}, or write ${{{inside[1]}}} for a text"
    out.findings.append(Finding("wrong-type", Severity.ERROR, message, source.span(path), hint))
    return text


def _text(text: str, path: KeyPath, source: Source, known: _Variables, out: Filled) -> str:
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
                f"{'${' if match[0] == '$' else match[0]} is not a variable",
                "write ${NAME}, or $$ for a dollar",
                match,
            )
            return match[0]
        name, _, operator, rest = inside.groups()
        value = known.get(name)
        if value is not None:
            return value.replace("$", "$$") if known.alone else value
        if operator == "-":
            return rest
        out.unknown.add(path)
        if known.env is not None and name not in known.axes:
            why = f": {rest}" if operator == "?" and rest else ""
            report("unset-variable", f"{name} is not set{why}", f"set {name} in the environment", match)
        return match[0]

    def report(rule: str, message: str, remedy: str, match: re.Match[str]) -> None:
        span = source.inner_span(path, match.start(), max(match.end(), match.start() + 1))
        out.findings.append(Finding(rule, Severity.ERROR, message, span, remedy))

    return _REFERENCE.sub(replace, text)


MAX_FILES = 100
"""Maximum number of files that one document may extend; a file counts each time it is named."""


def extended(source: Source, *, folder: Path) -> Source:
    """Return a document merged with the files it extends.

    Mappings are merged key by key, and the document's own values take precedence. An empty value removes a key. Relative
    paths of other files are rewritten to start at `folder`, the document's folder. The findings include those of the
    other files.
    """
    return _extended(source, folder, (), count(1))


def bases_of(source: Source, *, folder: Path) -> Iterator[tuple[Path, Span]]:
    """Yield the files that a document extends with their spans; later files take precedence."""
    names = source.at((EXTENDS_KEY,))
    for position, name in enumerate(names if isinstance(names, list) else [names]):
        if isinstance(name, str) and name:
            key_path = (EXTENDS_KEY, position) if isinstance(names, list) else (EXTENDS_KEY,)
            yield Path(normpath(folder / Path(name).expanduser())), source.span(key_path)


def _extended(source: Source, folder: Path, chain: tuple[Path, ...], read: Iterator[int]) -> Source:
    if not isinstance(source.value, dict):
        return source
    for path, span in reversed(list(bases_of(source, folder=folder))):
        base = _base(path, span, chain, read)
        if isinstance(base, Finding):
            source = replace(source, findings=(*source.findings, base))
        else:
            source = _joined(source, _moved(base, relpath(path.parent, folder)))
    return source


def _base(path: Path, span: Span, chain: tuple[Path, ...], read: Iterator[int]) -> Source | Finding:
    """Return a file that is extended at `span`, merged with its own bases, or a finding if that fails."""
    here = path.resolve()
    if here in chain:
        names = " → ".join(file.name for file in (*chain[chain.index(here) :], here))
        return _finding(f"files extend one another: {names}", span, "remove one of them")
    if next(read) > MAX_FILES:
        return _finding(f"{path} is one of more than {MAX_FILES} files", span, "extend fewer files")
    try:
        text = read_limited(path).decode()
    except (OSError, UnicodeDecodeError) as error:
        why = (error.strerror or str(error)).lower() if isinstance(error, OSError) else "it is not UTF-8"
        return _finding(f"{path} cannot be extended: {why}", span, "name a manifest, or a part of one")
    source = load_source(text, file=str(path))
    if not isinstance(source.value, dict) and not source.findings:
        return _finding(f"{path} cannot be extended: it is not a mapping", span, "name a part of a manifest")
    return _extended(source, path.parent, (*chain, here), read)


def _finding(message: str, span: Span, remedy: str) -> Finding:
    return Finding("missing-base", Severity.ERROR, message, span, remedy)


class _Join(Struct):
    """A merge of two values that records inherited and removed key paths."""

    inherited: set[KeyPath] = field(default_factory=set[KeyPath])
    dropped: set[KeyPath] = field(default_factory=set[KeyPath])

    def value(self, own: Value, base: Value, path: KeyPath) -> Value:
        if not (isinstance(own, dict) and isinstance(base, dict)):
            return own
        joined: dict[Scalar, Value] = {}
        for key, value in own.items():
            if value is None and key in base:
                self.dropped.add((*path, key))
            else:
                joined[key] = self.value(value, base[key], (*path, key)) if key in base else value
        for key in base:
            if key not in own and (*path, key) != (EXTENDS_KEY,):
                self.inherited.add((*path, key))
                joined[key] = base[key]
        return joined

    def spans(self, own: dict[KeyPath, Span], base: dict[KeyPath, Span]) -> dict[KeyPath, Span]:
        own_spans = {path: span for path, span in own.items() if not _below(path, self.dropped)}
        return {**own_spans, **{path: span for path, span in base.items() if _below(path, self.inherited)}}


def _below(path: KeyPath, roots: set[KeyPath]) -> bool:
    return any(path[:length] in roots for length in range(1, len(path) + 1))


def _joined(own: Source, base: Source) -> Source:
    join = _Join()
    value = join.value(own.value, base.value, ())
    return Source(
        own.file,
        own.text,
        value,
        (*own.findings, *base.findings),
        join.spans(own.spans, base.spans),
        join.spans(own.key_spans, base.key_spans),
        {**base.others, base.file: base.text, **own.others},
    )


def _moved(source: Source, prefix: str) -> Source:
    """Return a document with its relative paths prefixed by the folder `prefix`."""
    if prefix == ".":
        return source
    value = source.value
    for marked in (*marked_fields(Manifest, FilePath), *marked_fields(Manifest, AdapterRef)):
        is_path = isinstance(marked.marker, FilePath)

        def rebase(_: KeyPath, text: str, *, is_path: bool = is_path) -> str:
            if not _is_relative(text) or not (is_path or is_adapter_path(text)):
                return text
            return Path(normpath(Path(prefix, text))).as_posix()

        value = replace_values(value, marked.path, rebase)
    return replace(source, value=value)


def is_adapter_path(text: str) -> bool:
    """Return whether a reference to an adapter names a file: a YAML file or `file.py:Class`."""
    return text.endswith((".yaml", ".yml")) or ".py:" in text


def _is_relative(text: str) -> bool:
    """Return whether a path is relative to the manifest's folder; a path that starts with a variable may be absolute."""
    return text != "" and not text.startswith(("/", "~", "${")) and not is_url(text)


class LoadedManifest(Struct, frozen=True):
    """A valid manifest, with the span of each of its values."""

    manifest: Manifest
    source: Source
    path: Path
    cell: Mapping[str, str] = field(default_factory=dict[str, str])
    """The values of the matrix variables for this job."""

    @property
    def origin(self) -> Origin:
        """The manifest's file and folder, and the span of each key and value."""
        return Origin(str(self.path), self.path.parent, self.source.spans, self.source.key_spans)

    def where(self, *path: str | int) -> str:
        """Return `file:line:column` of the value at a key path."""
        return str(self.source.span(path))

    def for_recording(self, recording: AnyPath) -> LoadedManifest:
        """Return the manifest with another recording."""
        path = recording.url if isinstance(recording, RemotePath) else str(recording)
        bag = self.manifest.bag.replace(path=path)
        return replace(self, manifest=self.manifest.replace(bag=bag))

    def resolve(self, path: str, *key_path: str | int) -> Path:
        """Return a path of the manifest as a path relative to the current folder.

        Raises:
            ManifestError: The path is a URL; the error's location is that of `key_path`.
        """
        if is_url(path):
            message = f"{'.'.join(map(str, key_path))} is a URL, but only recordings and stores can be URLs"
            raise self._wrong_url(message, "name a local file", key_path)
        return self.path.parent / Path(path).expanduser()

    def resolve_or_url(self, path: str, *key_path: str | int) -> AnyPath:
        """Return a path of the manifest as a path relative to the current folder, or the remote path of a URL.

        Raises:
            ManifestError: The URL is invalid; the error's location is that of `key_path`.
        """
        if not is_url(path):
            return self.resolve(path, *key_path)
        try:
            return parse_url(path)
        except IngestError as error:
            raise self._wrong_url(f"{error.where}: {error.what}", error.hint, key_path) from error

    def _wrong_url(self, message: str, hint: str | None, key_path: KeyPath) -> ManifestError:
        finding = Finding("wrong-url", Severity.ERROR, message, self.source.span(key_path), hint)
        return ManifestError(message, where=str(finding.span), hint=hint, findings=(finding,))


def load_manifest(path: Path | str, *, env: Mapping[str, str] | None = os.environ) -> LoadedManifest:
    """Load a job manifest, or the first job of its matrix; see `load_manifests`."""
    return load_manifests(path, env=env)[0]


def load_manifests(
    path: Path | str, *, env: Mapping[str, str] | None = os.environ
) -> tuple[LoadedManifest, ...]:
    """Load every job of a manifest, merged with the files it extends; `env=None` ignores the environment.

    Raises:
        ManifestError: The file cannot become a job; `findings` has one entry for each mistake.
    """
    file = Path(path)
    source = read_manifest(file)
    jobs: list[LoadedManifest] = []
    findings: dict[Finding, None] = {}
    for cell in combinations(source.value):
        manifest, mistakes = check_manifest(source, env=env, cell=cell)
        findings.update(dict.fromkeys(mistakes))
        if manifest is not None:
            jobs.append(LoadedManifest(manifest, source, file, cell))
    if findings or not jobs:
        raise refusal(tuple(findings), str(path))
    return tuple(jobs)


def read_manifest(path: Path) -> Source:
    """Read a manifest merged with the files it extends; `findings` has the mistakes of all of them.

    Raises:
        ManifestError: The file cannot be read.
    """
    return extended(load_source(read_text(path), file=str(path)), folder=path.parent)


def check_manifest(
    source: Source, *, env: Mapping[str, str] | None, cell: Mapping[str, str] | None = None
) -> tuple[Manifest | None, tuple[Finding, ...]]:
    """Return the model (None if the manifest has mistakes) and the findings in the order of the text.

    `cell` contains the values of one combination of the matrix and defaults to the first combination.
    """
    if not isinstance(source.value, dict):
        return None, source.findings or (_not_a_job(source),)
    filled = fill_in(source, env, cell)
    findings = [*source.findings, *filled.findings]
    filled.value = _without_other_keys(filled.value, (), source, findings)
    manifest, mistakes = _validate(source, filled)
    reported = {finding.span for finding in findings}
    if any(finding.rule == "missing-base" for finding in findings):
        mistakes = [finding for finding in mistakes if finding.rule != "missing-key"]
    findings += [finding for finding in mistakes if finding.span not in reported]
    ordered = tuple(sorted(findings, key=lambda finding: finding.span or Span("", 0, 0, 0, 0)))
    return (None if ordered else manifest), ordered


def stand_alone(source: Source, cell: Mapping[str, str]) -> Value:
    """Return one job of a manifest as a document without `extends` and `matrix`, with the matrix variables replaced.

    Environment variables stay as written, together with the defaults that they may need.
    """
    filled = fill_in_cell(source, cell)
    _validate(source, filled)  # converts the texts that have to be numbers
    if not isinstance(filled.value, dict):
        return filled.value
    defaults = filled.value.get("defaults")
    job = {key: value for key, value in filled.value.items() if key not in {"extends", "defaults", "matrix"}}
    if isinstance(defaults, dict) and (unfilled := {k: v for k, v in defaults.items() if k not in cell}):
        return {"defaults": unfilled, **job}
    return job


def read_text(path: Path) -> str:
    """Return the text of a file.

    Raises:
        ManifestError: The file does not exist, is not readable, or is not UTF-8.
    """
    if path.is_dir() or RECORDING_NAME.search(path.name):
        kind = "a folder" if path.is_dir() else "a recording"
        finding = Finding(
            "unreadable-file", Severity.ERROR, f"{path} is {kind}, not a manifest", help=_WITHOUT_MANIFEST
        )
        raise refusal((finding,), str(path))
    try:
        return read_limited(path).decode()
    except UnicodeDecodeError as err:
        message = f"not UTF-8 text: byte {err.start} is 0x{err.object[err.start]:02x}"
        finding = Finding(
            "not-utf8", Severity.ERROR, message, Span(str(path), 1, 1, 1, 1), "save it as UTF-8"
        )
        raise refusal((finding,), str(path)) from err
    except OSError as err:
        message = f"cannot be read: {(err.strerror or str(err)).lower()}"
        finding = Finding("unreadable-file", Severity.ERROR, message, Span(str(path), 1, 1, 1, 1))
        raise refusal((finding,), str(path)) from err


def refusal(findings: tuple[Finding, ...], where: str) -> ManifestError:
    """Return the error for a manifest with these findings, or for a manifest that is incomplete without its variables."""
    if not findings:
        return ManifestError(
            "the manifest is incomplete without its environment variables",
            where=where,
            hint="set them in the environment",
        )
    first = findings[0]
    if len(findings) == 1:
        return ManifestError(
            first.message, where=str(first.span or where), hint=first.help, findings=findings
        )
    return ManifestError(
        f"{len(findings)} mistakes; the first: {first.message}", where=where, findings=findings
    )


def _not_a_job(source: Source) -> Finding:
    span = source.span(())
    if source.value is None:
        return Finding(
            "empty-manifest", Severity.ERROR, "the manifest is empty", span, "start with bag: {path: …}"
        )
    return Finding("not-a-mapping", Severity.ERROR, "a job is a mapping", span, "start with bag: {path: …}")


def _without_other_keys(value: Value, path: KeyPath, source: Source, findings: list[Finding]) -> Value:
    """Report keys that are not text, and return the value without them."""
    if isinstance(value, list):
        return [_without_other_keys(item, (*path, i), source, findings) for i, item in enumerate(value)]
    if not isinstance(value, dict):
        return value
    for key in value:
        if not isinstance(key, str):
            span = source.key_span((*path, key))
            message = f"the key {json.dumps(key)} is not text"
            findings.append(Finding("yaml-key", Severity.ERROR, message, span, "quote it"))
    return {
        key: _without_other_keys(inner, (*path, key), source, findings)
        for key, inner in value.items()
        if isinstance(key, str)
    }


def _validate(source: Source, filled: Filled) -> tuple[Manifest | None, list[Finding]]:
    """Validate a document: convert replaced texts to numbers if required, and ignore values with unset variables."""
    manifest, mistakes = _attempt(source, filled.value)
    retry = [key_path for key_path, _ in mistakes if key_path in filled.changed]
    if retry:
        for key_path in dict.fromkeys(retry):
            _reread(filled, key_path)
        manifest, mistakes = _attempt(source, filled.value)
    return manifest, [finding for key_path, finding in mistakes if key_path not in filled.unknown]


def _attempt(source: Source, value: Value) -> tuple[Manifest | None, list[tuple[KeyPath, Finding]]]:
    try:
        # In JSON mode, `strict` refuses text for numbers and accepts lists for tuples and words for enumerations.
        manifest = Manifest.model_validate_json(json.dumps(value), strict=True)
    except ValidationError as error:
        return None, explain(error, source=source, schema=_schema())
    mistakes = [(path, _empty_value(source, path)) for path in _nulls(manifest)]
    return None if mistakes else manifest, mistakes


def _nulls(section: object, path: KeyPath = ()) -> Iterator[KeyPath]:
    """Yield the key path of each null that a manifest contains; free values, such as metadata, may contain null."""
    if isinstance(section, Section):
        for name in section.model_fields_set:
            value = getattr(section, name)
            if value is None:
                yield (*path, name)
            else:
                yield from _nulls(value, (*path, name))
    elif isinstance(section, dict):
        for key, value in cast("dict[str, object]", section).items():
            yield from _nulls(value, (*path, key))
    elif isinstance(section, tuple):
        for position, value in enumerate(cast("tuple[object, ...]", section)):
            yield from _nulls(value, (*path, position))


def _empty_value(source: Source, path: KeyPath) -> Finding:
    message = f"{'.'.join(map(str, path))} is empty"
    hint = "give it a value, or remove the key"
    return Finding("empty-value", Severity.ERROR, message, source.key_span(path), hint)


def _reread(filled: Filled, key_path: KeyPath) -> None:
    """Convert a replaced text to the value of an unquoted YAML scalar, or remove it if its variable is not set."""
    parent = filled.value
    for part in key_path[:-1]:
        parent = member(parent, part)
    if isinstance(parent, dict):
        value = parent[key_path[-1]]
        if key_path in filled.unknown:
            del parent[key_path[-1]]
        elif isinstance(value, str):
            parent[key_path[-1]] = resolve_plain(value)[0]


@cache
def _schema() -> dict[str, Any]:
    from mosaico_ingest.job.reference import job_schema  # noqa: PLC0415 - only mistakes need the schema

    return job_schema()
