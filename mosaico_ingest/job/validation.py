"""Findings of manifests: the errors of pydantic with locations, hints and fixes, and patterns that match no topic."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from math import isfinite
from typing import Any

from msgspec import Struct
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from mosaico_ingest.findings import Edit, Finding, Severity, Span, nearest, normalized_word
from mosaico_ingest.job.fields import TopicGlob, marked_fields, values_at
from mosaico_ingest.job.model import JobSettings, Manifest
from mosaico_ingest.job.yaml_source import KeyPath, Source, Value, member

_EXPECTED = {
    "string_type": "text",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "bool_type": "true or false",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "a mapping",
    "model_type": "a mapping",
    "model_attributes_type": "a mapping",
}
_BRACED = re.compile(r"\{\w+\}")
_PLAIN = re.compile(r"[^\s\"'\\#&*!|>@`%\[\],]+")


class _Problem(Struct, frozen=True):
    error: ErrorDetails
    path: KeyPath
    value: Value
    source: Source
    schema: dict[str, Any]

    @property
    def name(self) -> str:
        """The value's key path as text."""
        return key_path_text(self.path) or "the document"

    @property
    def span(self) -> Span:
        """The value's span."""
        return self.source.span(self.path)

    @property
    def secret(self) -> bool:
        """True if the value must not be shown."""
        return _node_at(self.schema, self.path).get("writeOnly", False)

    def finding(
        self, rule: str, message: str, remedy: str | None, span: Span | None = None, fix: Edit | None = None
    ) -> Finding:
        return Finding(rule, Severity.ERROR, message, span or self.span, remedy, fix)


def explain(
    error: ValidationError, *, source: Source, schema: dict[str, Any]
) -> list[tuple[KeyPath, Finding]]:
    """Return one finding for each mistake, with the key path of the value.

    Values are quoted as written, so the values of variables, which may be secret, never appear.

    `schema` is the JSON Schema of the model that refused the document.
    """
    problems = [_problem(details, source, schema) for details in error.errors(include_url=False)]
    suggestions = {(*problem.path[:-1], _suggestion(problem)) for problem in problems}
    return [
        (problem.path, _describe(problem))
        for problem in problems
        if problem.error["type"] != "missing" or (*problem.path, problem.error["loc"][-1]) not in suggestions
        if problem.error["type"] != "too_short" or not _any_below(problem.path, problems)
    ]


def _any_below(path: KeyPath, problems: Iterable[_Problem]) -> bool:
    """Return whether a value below `path` has a problem; a list is then too short only because its items were refused."""
    return any(problem.path[: len(path)] == path and problem.path != path for problem in problems)


def key_path_of(location: KeyPath, value: Value) -> KeyPath:
    """Return the key path of an error's location, without the parts that the document does not have (union tags)."""
    path: KeyPath = ()
    for part in location:
        with suppress(LookupError):
            value = member(value, part)
            path = (*path, part)
    return path


def keys_at(schema: dict[str, Any], path: KeyPath) -> list[str]:
    """Return the keys that a JSON Schema allows in the mapping at `path`; empty if every key is allowed."""
    return list(_resolved(_node_at(schema, path), schema, {"object"}).get("properties", {}))


def _node_at(schema: dict[str, Any], path: KeyPath) -> dict[str, Any]:
    node = schema
    for part in path:
        kind = "array" if isinstance(part, int) else "object"
        node = _descend(_resolved(node, schema, {kind}), part)
    return node


def key_path_text(path: KeyPath) -> str:
    """Return a key path as text, such as `bag.custom_msgs[0].path`."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path).lstrip(".")


def _problem(details: ErrorDetails, source: Source, schema: dict[str, Any]) -> _Problem:
    path = key_path_of(details["loc"], source.value)
    return _Problem(details, path, source.at(path), source, schema)


def _descend(node: dict[str, Any], part: object) -> dict[str, Any]:
    if isinstance(part, int):
        return node.get("items", {})
    inner = node.get("properties", {}).get(part)
    extra = node.get("additionalProperties")
    return inner or (extra if isinstance(extra, dict) else {})


def _resolved(
    node: dict[str, Any], schema: dict[str, Any], kinds: Collection[str] = ("object", "array")
) -> dict[str, Any]:
    """Follow references, and select the alternative of one of these JSON types."""
    while "$ref" in node:
        node = schema["$defs"][node["$ref"].rsplit("/", 1)[-1]]
    for branch in node.get("anyOf", node.get("oneOf", ())):
        resolved = _resolved(branch, schema, kinds)
        if resolved.get("type") in kinds:
            return resolved
    return node


def _describe(problem: _Problem) -> Finding:
    kind = problem.error["type"]
    describe = _DESCRIBERS.get(kind)
    if describe is not None:
        return describe(problem)
    if kind in _EXPECTED:
        return _wrong_type(problem, _EXPECTED[kind])
    message = problem.error["msg"].removeprefix("Value error, ")
    return problem.finding("wrong-value", f"{problem.name}: {message}", _example(problem))


def _suggestion(problem: _Problem) -> str | None:
    """Return the allowed key that is closest to an unknown key, or None."""
    if problem.error["type"] != "extra_forbidden":
        return None
    return nearest(str(problem.path[-1]), keys_at(problem.schema, problem.path[:-1]))


def _unknown_key(problem: _Problem) -> Finding:
    parent, word = problem.path[:-1], str(problem.path[-1])
    allowed = keys_at(problem.schema, parent)
    span = problem.source.key_span(problem.path)
    section = f"in {key_path_text(parent)}" if parent else "at the top level"
    close = _suggestion(problem)
    if close:
        remedy = f"did you mean {close!r}? "
    elif {"value", "fields"} <= set(allowed):  # a mapping's value
        remedy = f"a struct is written {{fields: {{{word}: …}}}}; "
    else:
        remedy = _elsewhere(word, problem.schema)
    fix = (
        Edit(span, close)
        if close and normalized_word(close).replace("_", "") == normalized_word(word).replace("_", "")
        else None
    )
    message = f"unknown key {word!r} {section}"
    return problem.finding("unknown-key", message, f"{remedy}allowed: {', '.join(allowed)}", span, fix)


def _elsewhere(word: str, schema: dict[str, Any]) -> str:
    """Return a hint with the section that allows the key, or an empty text."""
    for section in keys_at(schema, ()):
        if word in keys_at(schema, (section,)):
            return f"move it to {section!r}; "
    return ""


def _missing_key(problem: _Problem) -> Finding:
    key = problem.error["loc"][-1]
    span = problem.source.key_span(problem.path)
    if not problem.path:
        span = Span(span.file, span.line, span.column, span.line, span.column + 1)
    return problem.finding("missing-key", f"{problem.name} needs the key {key!r}", f"add {key}:", span)


def _wrong_type(problem: _Problem, expected: str) -> Finding:
    value, name = problem.value, problem.name
    if value is None:
        span = problem.source.key_span(problem.path)
        return problem.finding("empty-value", f"{name} is empty", "give it a value, or remove the key", span)
    if problem.secret:
        return problem.finding("wrong-type", f"{name} must be {expected}", "quote it")
    message = f"{name} must be {expected}, not {_kind(value)}"
    text = _written(problem)
    remedy = fix = None
    node = _node_at(problem.schema, problem.path)
    if expected == "text" and not _fits(text, node, problem.schema):
        remedy = _example(problem)
    elif expected == "text" and (_PLAIN.fullmatch(text) or _BRACED.fullmatch(text)):
        remedy, fix = f'quote it: "{text}"', Edit(problem.span, f'"{text}"')
    elif expected == "a list":
        remedy = _list_example(problem, node)
    elif expected == "a whole number" and isinstance(value, float):
        remedy = "write a whole number" + (f", such as {round(value)}" if isfinite(value) else "")
    elif expected == "a whole number" and isinstance(value, str) and value.strip().isdigit():
        remedy, fix = f"write {value.strip()} without quotes", Edit(problem.span, value.strip())
    elif expected == "a mapping":
        keys = keys_at(problem.schema, problem.path)
        remedy = f"its keys are {', '.join(keys)}" if keys else "write key: value pairs"
    return problem.finding("wrong-type", message, remedy or _example(problem) or f"write {expected}", fix=fix)


def _list_example(problem: _Problem, node: dict[str, Any]) -> str | None:
    """Return a hint with a list that has the value as its item, or items with their required keys."""
    item = _resolved(_resolved(node, problem.schema).get("items", {}), problem.schema)
    if item.get("type") != "object":
        return f'write ["{problem.value}"]' if isinstance(problem.value, str) else None
    examples = {key: item["properties"][key].get("examples", ["…"])[0] for key in item.get("required", ())}
    return f"write [{{{', '.join(f'{key}: {example}' for key, example in examples.items())}}}]"


def _example(problem: _Problem) -> str | None:
    """Return a hint with the examples of the field."""
    examples = _node_at(problem.schema, problem.path).get("examples", ())
    texts = [str(example) for example in examples if isinstance(example, str | int | float)]
    return f"write a value such as {' or '.join(texts)}" if texts else None


def _fits(text: str, node: dict[str, Any], schema: dict[str, Any]) -> bool:
    """Return whether a text matches the patterns of the schema, if it has any."""
    branches = [_resolved(branch, schema) for branch in node.get("anyOf", [node])]
    patterns = [branch["pattern"] for branch in branches if "pattern" in branch]
    return not patterns or any(re.search(pattern, text) for pattern in patterns)


def _written(problem: _Problem) -> str:
    span = problem.span
    if span.line != span.end_line:
        return ""
    return problem.source.line(span)[span.column - 1 : span.end_column - 1]


def _kind(value: Value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return f"the number {value}"
    if isinstance(value, str):
        return f"the text {value!r}"
    return "a list" if isinstance(value, list) else "a mapping"


def _not_a_choice(problem: _Problem) -> Finding:
    allowed = problem.error.get("ctx", {}).get("expected", "")
    if problem.value is None:
        return _wrong_type(problem, "text")
    value_text = repr(problem.value) if isinstance(problem.value, str) else _kind(problem.value)
    words = re.findall(r"'([^']*)'", allowed)
    close = nearest(problem.value, words) if isinstance(problem.value, str) else None
    remedy = f"did you mean {close!r}? " if close else ""
    choices = ", ".join(words) or allowed
    exact = (
        close is not None
        and isinstance(problem.value, str)
        and normalized_word(close).endswith(normalized_word(problem.value))
    )
    fix = Edit(problem.span, close) if close and exact else None
    return problem.finding(
        "wrong-value", f"{problem.name} cannot be {value_text}", f"{remedy}allowed: {choices}", fix=fix
    )


def _out_of_range(problem: _Problem) -> Finding:
    bounds = problem.error.get("ctx", {})
    if problem.path == ("version",) and "le" in bounds:
        message = f"version {problem.value} is newer than {bounds['le']}, the newest supported version"
        return problem.finding("newer-version", message, "upgrade mosaico-ingest")
    words = {"ge": "at least", "le": "at most", "gt": "more than", "lt": "less than"}
    limit = next(f"{words[key]} {bounds[key]}" for key in words if key in bounds)
    return problem.finding("wrong-value", f"{problem.name} is {problem.value}", f"it must be {limit}")


def _empty(problem: _Problem) -> Finding:
    return problem.finding("empty-value", f"{problem.name} is empty", "give it a value, or remove the key")


def _contradiction(problem: _Problem) -> Finding:
    """Return the finding for two keys of a section that exclude each other; the span is that of the key in the error."""
    key = problem.error.get("ctx", {}).get("key", "")
    span = problem.source.key_span((*problem.path, key))
    return problem.finding("conflicting-keys", problem.error["msg"], "keep one of the two", span)


_DESCRIBERS: dict[str, Callable[[_Problem], Finding]] = {
    "extra_forbidden": _unknown_key,
    "missing": _missing_key,
    "enum": _not_a_choice,
    "literal_error": _not_a_choice,
    "greater_than_equal": _out_of_range,
    "greater_than": _out_of_range,
    "less_than_equal": _out_of_range,
    "less_than": _out_of_range,
    "string_too_short": _empty,
    "too_short": _empty,
    "conflicting-keys": _contradiction,
}

_MISTAKES = (
    (
        re.compile(r"\.[*+]|\\|[$^()|]"),
        "it is a regular expression",
        "write a glob, in which * matches any text",
    ),
    (re.compile(r"\s"), "it contains a space", "remove the space"),
    (re.compile(r"//"), "it contains two slashes in a row", "remove one slash"),
    (re.compile(r"(?<=.)/$"), "it ends with a slash", "remove the slash, or write /*"),
    (
        re.compile(r"\[(?!(?:!|(?!!))(?:\][^\]]*|[^\]]+)\]).*"),
        "its [ is never closed",
        "close the bracket, as in [ab], or write ? for a single character",
    ),
)


class PatternProblem(Struct, frozen=True):
    """A pattern that cannot match, the reason with its span, and a hint."""

    pattern: str
    message: str
    span: Span
    hint: str


def pattern_problems(manifest: Manifest, source: Source) -> Iterator[PatternProblem]:
    """Yield a problem for each pattern of `topics` and `expect` that cannot match any topic name."""
    for field in marked_fields(JobSettings, TopicGlob):
        if field.is_key:
            continue
        for path, pattern in values_at(manifest, field.path):
            if isinstance(pattern, str) and (pattern == "" or pattern != field.marker.default):
                yield from _problems(pattern, path, source, excludes=field.marker.excludes)


def _problems(pattern: str, path: KeyPath, source: Source, *, excludes: bool) -> Iterator[PatternProblem]:
    if excludes and pattern in {"", "!"}:
        yield PatternProblem(pattern, f"{pattern!r} excludes nothing", source.span(path), 'write "!/topic"')
        return
    for mistake, reason, hint in _MISTAKES:
        match = mistake.search(pattern)
        if match is not None:
            span = source.inner_span(path, match.start(), match.end())
            yield PatternProblem(pattern, f"{pattern!r} matches no topic, because {reason}", span, hint)
            return
