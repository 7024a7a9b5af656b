"""Composition of manifests: environment variables, placeholders, `extends` and `matrix`."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import count, product
from os.path import normpath, relpath
from pathlib import Path as File

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.findings import Finding, Severity, Span
from mosaico_ingest.job.fields import AdapterRef, FilePath, Literally, marked_fields, replace_values
from mosaico_ingest.job.model import MAX_JOBS, Manifest
from mosaico_ingest.job.yaml_source import KeyPath, Scalar, Source, Value, load_source
from mosaico_ingest.remote import is_url
from mosaico_ingest.textfile import read_limited

PLACEHOLDERS = ("stem", "name", "parent", "date", "index")

_WIDTH = re.compile(r"0?[0-9]")
_BRACED = re.compile(r"\{([^{}]*)\}")


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


MATRIX_KEY = "matrix"


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


_REFERENCE = re.compile(r"\$(?:(\$)|\{([^{}]*)\}|(?=\{))")
_INSIDE = re.compile(r"([A-Za-z_][A-Za-z0-9_]*)(?::(int|float|bool))?(?::([-?])(.*))?", re.DOTALL)
_KINDS: Mapping[str, tuple[re.Pattern[str], Callable[[str], Scalar], str]] = {
    "int": (re.compile(r"[+-]?[0-9]+"), int, "a whole number"),
    "float": (re.compile(r"[+-]?[0-9]+(\.[0-9]+)?([eE][+-]?[0-9]+)?"), float, "a number"),
    "bool": (re.compile(r"[Tt]rue|[Ff]alse"), lambda text: text.lower() == "true", "true or false"),
}
"""The notation, the conversion and the description of the values of each kind of variable."""


@dataclass(slots=True)
class Filled:
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


EXTENDS_KEY = "extends"
MAX_FILES = 100
"""Maximum number of files that one document may extend; a file counts each time it is named."""


def extended(source: Source, *, folder: File) -> Source:
    """Return a document merged with the files it extends.

    Mappings are merged key by key, and the document's own values take precedence. An empty value removes a key. Relative
    paths of other files are rewritten to start at `folder`, the document's folder. The findings include those of the
    other files.
    """
    return _extended(source, folder, (), count(1))


def bases_of(source: Source, *, folder: File) -> Iterator[tuple[File, Span]]:
    """Yield the files that a document extends with their spans; later files take precedence."""
    names = source.at((EXTENDS_KEY,))
    for position, name in enumerate(names if isinstance(names, list) else [names]):
        if isinstance(name, str) and name:
            key_path = (EXTENDS_KEY, position) if isinstance(names, list) else (EXTENDS_KEY,)
            yield File(normpath(folder / File(name).expanduser())), source.span(key_path)


def _extended(source: Source, folder: File, chain: tuple[File, ...], read: Iterator[int]) -> Source:
    if not isinstance(source.value, dict):
        return source
    for path, span in reversed(list(bases_of(source, folder=folder))):
        base = _base(path, span, chain, read)
        if isinstance(base, Finding):
            source = replace(source, findings=(*source.findings, base))
        else:
            source = _joined(source, _moved(base, relpath(path.parent, folder)))
    return source


def _base(path: File, span: Span, chain: tuple[File, ...], read: Iterator[int]) -> Source | Finding:
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


@dataclass(slots=True)
class _Join:
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
            return File(normpath(File(prefix, text))).as_posix()

        value = replace_values(value, marked.path, rebase)
    return replace(source, value=value)


def is_adapter_path(text: str) -> bool:
    """Return whether a reference to an adapter names a file: a YAML file or `file.py:Class`."""
    return text.endswith((".yaml", ".yml")) or ".py:" in text


def _is_relative(text: str) -> bool:
    """Return whether a path is relative to the manifest's folder; a path that starts with a variable may be absolute."""
    return text != "" and not text.startswith(("/", "~", "${")) and not is_url(text)
