"""Texts that are derived from manifests and their model: composed manifests and the JSON Schema."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

from msgspec import Struct

from mosaico_ingest.documents import DIALECT, schema_of, tidy
from mosaico_ingest.findings import Finding, mask_credentials
from mosaico_ingest.job.fields import Secret, marked_fields
from mosaico_ingest.job.manifest import (
    EXTENDS_KEY,
    check_manifest,
    combinations,
    read_manifest,
    refusal,
    stand_alone,
)
from mosaico_ingest.job.model import Manifest
from mosaico_ingest.job.yaml_source import KeyPath, Scalar, Source, Value, resolve_plain

Remark: TypeAlias = Callable[[KeyPath], "str | None"]
"""A function that returns the comment for the value at a key path, or None."""

_PLAIN = re.compile(r"[A-Za-z0-9_./~+-]([A-Za-z0-9_./~+:-]*[A-Za-z0-9_./~+-])?")
_UNPRINTABLE = re.compile(r"[\x7f-\x9f\u2028\u2029\ufeff\ud800-\udfff\ufffe\uffff]")
_WIDTH = 100
MASK = "***"
_SECRET_KEYS = frozenset(str(field.path[-1]) for field in marked_fields(Manifest, Secret))
_SECRET = re.compile(rf"{'|'.join(sorted(_SECRET_KEYS))}|api_?key|password|token|secret", re.IGNORECASE)
"""Keys of secrets: keys that the model marks, and common names in metadata and variables."""
_IN_TEXT = re.compile(
    r"(?<=://)[^/@\s]+(?=@)|msco_\w+|(?<=[?&])([^=&\s]*(?:key|password|token|secret)[^=&\s]*=)[^&\s]+",
    re.IGNORECASE,
)
"""API keys, credentials of URLs, and secret options of URLs."""
_VARIABLE_NAME = re.compile(r"\$\{(\w+)(?:[^{}]*)\}")
_VARIABLE = {"type": "string", "pattern": r"\$\{[^{}]+\}", "description": "An environment variable."}


def plain(value: Scalar) -> str:
    """Return a scalar as YAML, quoted if YAML readers would disagree about its value."""
    if not isinstance(value, str):
        return _number(value) if isinstance(value, float) else json.dumps(value)
    if _PLAIN.fullmatch(value) and resolve_plain(value) == (value, None) and value[0] not in "-~":
        return value
    quoted = json.dumps(value, ensure_ascii=False)
    return _UNPRINTABLE.sub(lambda match: f"\\u{ord(match[0]):04x}", quoted)


def to_yaml(value: Value, remark: Remark = lambda _: None) -> str:
    """Return a document in block style, with short lists of scalars on one line."""
    if isinstance(value, dict | list) and value:
        return "".join(f"{line}\n" for line in _lines(value, (), remark))
    return f"{_flow(value)}\n"


def _lines(value: Value, path: KeyPath, remark: Remark) -> Iterator[str]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _entry(f"{plain(key)}:", inner, (*path, key), remark)
    elif isinstance(value, list):
        for position, inner in enumerate(value):
            yield from _item(inner, (*path, position), remark)


def _entry(head: str, value: Value, path: KeyPath, remark: Remark) -> Iterator[str]:
    if _is_short(value):
        comment = remark(path)
        yield f"{head} {_flow(value)}" + (f"  # {comment}" if comment else "")
    else:
        yield head
        yield from (f"  {line}" for line in _lines(value, path, remark))


def _item(value: Value, path: KeyPath, remark: Remark) -> Iterator[str]:
    if _is_short(value):
        yield from _entry("-", value, path, remark)
    else:
        lines = _lines(value, path, remark)
        yield f"- {next(lines)}"
        yield from (f"  {line}" for line in lines)


def _is_short(value: Value) -> bool:
    if isinstance(value, dict):
        return not value
    if isinstance(value, list):
        single = not any(isinstance(item, list | dict) for item in value)
        return single and len(_flow(value)) <= _WIDTH
    return True


def _flow(value: Value) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_flow(item) for item in value)}]"
    return "{}" if isinstance(value, dict) else plain(value)


def _number(value: float) -> str:
    if value != value:  # noqa: PLR0124 - not a number
        return ".nan"
    mantissa, exponent, power = repr(value).partition("e")
    if exponent and "." not in mantissa:
        mantissa += ".0"  # some YAML readers read 1e3 as text
    return {float("inf"): ".inf", float("-inf"): "-.inf"}.get(value, f"{mantissa}{exponent}{power}")


class Expanded(Struct, frozen=True):
    """One job, as a document that extends nothing and has no matrix."""

    source: Source
    cell: Mapping[str, str]
    """The values of the matrix variables for this job."""
    value: Value

    def remark(self, path: KeyPath) -> str | None:
        """Return the file and line of a value that comes from another file, or None."""
        span = self.source.span(path)
        return None if span.file == self.source.file else f"{span.file}:{span.line}"


def expand_manifest(path: Path) -> tuple[Expanded, ...]:
    """Return every job of a manifest, with its environment variables unreplaced and its secrets masked.

    Raises:
        ManifestError: The manifest has mistakes; `findings` has one entry for each.
    """
    source = read_manifest(path)
    cells = combinations(source.value)
    findings: dict[Finding, None] = {}
    for cell in cells:
        findings.update(dict.fromkeys(check_manifest(source, env=None, cell=cell)[1]))
    if findings:
        raise refusal(tuple(findings), str(path))
    return tuple(Expanded(source, cell, _without_secrets(stand_alone(source, cell))) for cell in cells)


def manifest_text(path: Path) -> str:
    """Return a manifest merged with the files it extends; comments name the file of each value from another file.

    Raises:
        ManifestError: The manifest cannot be read.
    """
    source = read_manifest(path)
    value = source.value
    if isinstance(value, dict):
        value = {key: inner for key, inner in value.items() if key != EXTENDS_KEY}

    def remark(key_path: KeyPath) -> str | None:
        span = source.span(key_path)
        return None if span.file == source.file else f"{span.file}:{span.line}"

    return to_yaml(_without_secrets(value), remark)


def _without_secrets(value: Value) -> Value:
    hidden = frozenset(name for text in _secrets(value) for name in _VARIABLE_NAME.findall(text))
    return _masked(value, hidden)


def _secrets(value: Value) -> Iterator[str]:
    """Yield the texts of a document below keys that indicate secrets."""
    if isinstance(value, list):
        for inner in value:
            yield from _secrets(inner)
    elif isinstance(value, dict):
        for key, inner in value.items():
            if isinstance(inner, str) and _SECRET.search(str(key)):
                yield inner
            else:
                yield from _secrets(inner)


def _masked(value: Value, hidden: frozenset[str], *, secret: bool = False) -> Value:
    """Mask texts below keys that indicate secrets, defaults of variables in such texts, and texts that look like keys."""
    if isinstance(value, list):
        return [_masked(inner, hidden, secret=secret) for inner in value]
    if isinstance(value, dict):
        return {
            key: _masked(inner, hidden, secret=secret or key in hidden or bool(_SECRET.search(str(key))))
            for key, inner in value.items()
        }
    if secret and value is not None:
        names = _VARIABLE_NAME.findall(value) if isinstance(value, str) else []
        return "".join(f"${{{name}}}" for name in names) or MASK
    if not isinstance(value, str):
        return value
    return mask_credentials(_IN_TEXT.sub(lambda match: (match[1] or "") + MASK, value))


def job_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) with which editors complete and check manifests."""
    schema = tidy(schema_of(Manifest))
    definitions: dict[str, Any] = schema.pop("$defs")
    for model in [schema, *definitions.values()]:
        model["properties"] = {
            key: _or_variable(node, definitions) for key, node in _properties(model).items()
        }
        if not model["properties"]:
            del model["properties"]
    definitions["Variable"] = _VARIABLE
    required = schema.pop("required")
    schema["anyOf"] = [
        {"required": required},
        {"required": [EXTENDS_KEY]},
    ]  # the extended files may provide the required keys
    return {"$schema": DIALECT, "title": "mosaico-ingest job", **schema, "$defs": definitions}


def _properties(model: dict[str, Any]) -> dict[str, Any]:
    return model.get("properties", {})


def _or_variable(node: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """Allow `${VAR}` for numbers and enumerations; texts allow it already."""
    target = definitions[node["$ref"].rsplit("/", 1)[-1]] if "$ref" in node else node
    if "enum" not in target and target.get("type") not in ("integer", "boolean"):
        return node
    about = {key: value for key, value in node.items() if key in {"default", "description", "examples"}}
    return {
        **about,
        "anyOf": [{k: v for k, v in node.items() if k not in about}, {"$ref": "#/$defs/Variable"}],
    }
