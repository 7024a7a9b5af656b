"""docs/manifest.md: the keys of manifests, derived from their JSON Schema."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, cast

from mosaico_ingest.job.reference import job_schema

_HEAD = """\
<!-- Generated from mosaico_ingest/job/model.py by `./dev docs`. -->

# Manifest keys

After reading this page, you know every key of a job manifest. Only `bag.path` is required.

* Relative paths start at the manifest's folder.
* `${VAR}`, `${VAR:-default}` and `${VAR:?message}` insert environment variables into texts, numbers and words; `$$` is a dollar sign.
* In metadata, where any type is valid, `${VAR}` is a text. `${VAR:int}`, `${VAR:float}` and `${VAR:bool}` are numbers, `true` or `false`.
* Unknown keys are errors. `ingest lint job.yaml` reports all problems of a manifest with their locations.
"""
_WORDS = {
    "string": "text",
    "integer": "number",
    "number": "number",
    "boolean": "true or false",
    "object": "mapping",
}


def manifest_reference() -> str:
    """Return docs/manifest.md, with a section for each part of the manifest and a row for each key."""
    schema = job_schema()
    sections = [_section("The manifest", schema, schema)]
    for path, model in _models(schema["properties"], (), schema):
        sections.append(_section(f"`{'.'.join(path)}`", model, schema))
    return _HEAD + "".join(sections)


def _models(
    properties: dict[str, Any], path: tuple[str, ...], schema: dict[str, Any]
) -> Iterator[tuple[tuple[str, ...], dict[str, Any]]]:
    """Yield the path and schema of every mapping with defined keys below these properties, in order."""
    for key, node in properties.items():
        name, inner = key, _mapping_form(_resolved(node, schema), schema)
        if "items" in inner:
            name, inner = f"{key}[]", _mapping_form(_resolved(inner["items"], schema), schema)
        elif isinstance(inner.get("additionalProperties"), dict):
            name, inner = f"{key}.*", _resolved(inner["additionalProperties"], schema)
        if "properties" in inner:
            yield (*path, name), inner
            yield from _models(inner["properties"], (*path, name), schema)


def _mapping_form(node: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    """Return the alternative with defined keys of a value that has short forms, and any other value unchanged."""
    branches = (_resolved(branch, schema) for branch in (*node.get("anyOf", ()), *node.get("oneOf", ())))
    return next((branch for branch in branches if "properties" in branch), node)


def _section(title: str, model: dict[str, Any], schema: dict[str, Any]) -> str:
    required = model.get("required", [])
    rows = "".join(_row(key, node, key in required, schema) for key, node in model["properties"].items())
    head = f"\n## {title}\n\n{model['description']}\n\n| key | type | default | description |\n|---|---|---|---|\n"
    return head + rows


def _row(key: str, node: dict[str, Any], required: bool, schema: dict[str, Any]) -> str:  # noqa: FBT001 - a row's cell
    described = node.get("description") or _resolved(node, schema).get("description", "")
    examples = node.get("examples", [])
    example = f" Example: {' or '.join(_code(example) for example in examples)}." if examples else ""
    cells = (f"`{key}`", _kind(node, schema), _default(node, required), f"{described}{example}")
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


def _default(node: dict[str, Any], required: bool) -> str:  # noqa: FBT001 - the key's state in the JSON Schema
    if required:
        return "required"
    default = node.get("default")
    return "" if default in (None, [], {}) or isinstance(default, dict) else _code(default)


def _kind(node: dict[str, Any], schema: dict[str, Any]) -> str:
    """Return the type of a value, or its allowed words."""
    branches = cast("list[dict[str, Any]]", node.get("anyOf") or node.get("oneOf") or [])
    if branches:
        branches = [branch for branch in branches if branch.get("type") != "null"]
        kinds = (_kind(branch, schema) for branch in branches if branch.get("$ref") != "#/$defs/Variable")
        return " or ".join(dict.fromkeys(kinds))
    node = _resolved(node, schema)
    if "enum" in node:
        return " ".join(_code(word) for word in node["enum"])
    if node.get("type") == "array":
        return f"list of {_kind(node['items'], schema)}"
    if isinstance(node.get("additionalProperties"), dict):
        inner = _kind(node["additionalProperties"], schema)
        return f"name → {inner}"
    kinds = node.get("type", "")
    return " or ".join(
        _WORDS.get(kind, "anything") for kind in ([kinds] if isinstance(kinds, str) else kinds)
    )


def _resolved(node: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    return schema["$defs"][node["$ref"].rsplit("/", 1)[-1]] if "$ref" in node else node


def _code(value: object) -> str:
    return f"`{value if isinstance(value, str) else json.dumps(value)}`"
