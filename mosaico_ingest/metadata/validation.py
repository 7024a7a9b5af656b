"""Validation of metadata against a JSON Schema, with the location of each violation in the manifest."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, cast

from msgspec import Struct

from mosaico_ingest.findings import Edit, Finding, Severity, Span, nearest
from mosaico_ingest.job.validation import key_path_text
from mosaico_ingest.job.yaml_source import KeyPath, resolve_plain
from mosaico_ingest.metadata.schema import MetadataSchema

_MAX_MESSAGE = 200
_MAX_CHOICES = 12
_TYPES = {
    "string": "text", "integer": "a whole number", "number": "a number", "boolean": "true or false",
    "object": "a mapping", "array": "a list", "null": "null",
}  # fmt: skip


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
