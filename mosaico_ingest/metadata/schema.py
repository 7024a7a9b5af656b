"""JSON Schemas for metadata: files, their references to each other, and the findings about both."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from datetime import datetime
from functools import cache
from os.path import normpath, relpath
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urldefrag, urljoin, urlsplit

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.errors import ManifestError
from mosaico_ingest.findings import Finding, Severity, Span
from mosaico_ingest.job.yaml_source import KeyPath, Source, load_source
from mosaico_ingest.remote import AnyPath
from mosaico_ingest.report.units import counted
from mosaico_ingest.textfile import read_limited

if TYPE_CHECKING:
    from jsonschema import FormatChecker
    from jsonschema.protocols import Validator
    from referencing import Registry, Resource

_LITERAL_KEYWORDS = frozenset({"const", "default", "enum", "examples"})
"""Keywords whose values are data, in which `$ref` has no meaning."""
_NAMED_SCHEMAS = frozenset({"properties", "patternProperties", "$defs", "definitions", "dependentSchemas"})
"""Keywords whose keys are names, not keywords."""
_MAX_MESSAGE = 200


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
