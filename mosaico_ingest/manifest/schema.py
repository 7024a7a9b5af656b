"""This file derives the JSON Schema of a job manifest from its model."""

from __future__ import annotations

from typing import Any, cast

from mosaico_ingest.manifest.extends import KEY as EXTENDS
from mosaico_ingest.manifest.model import Manifest
from mosaico_ingest.model_schema import schema_of

__all__ = ["DIALECT", "job_schema", "tidy"]

DIALECT = "https://json-schema.org/draft/2020-12/schema"
_VARIABLE = {"type": "string", "pattern": r"\$\{[^{}]+\}", "description": "A variable of the environment."}


def job_schema() -> dict[str, Any]:
    """Return the schema (draft 2020-12) that editors complete and check manifests with."""
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
    schema["anyOf"] = [{"required": required}, {"required": [EXTENDS]}]  # what is extended may say the rest
    return {"$schema": DIALECT, "title": "mosaico-ingest job", **schema, "$defs": definitions}


def _properties(model: dict[str, Any]) -> dict[str, Any]:
    return model.get("properties", {})


def _or_variable(node: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """Allow `${VAR}` where the value is a number or one of a few words; in a text it is allowed anyway."""
    target = definitions[node["$ref"].rsplit("/", 1)[-1]] if "$ref" in node else node
    if "enum" not in target and target.get("type") not in ("integer", "boolean"):
        return node
    about = {key: value for key, value in node.items() if key in {"default", "description", "examples"}}
    return {
        **about,
        "anyOf": [{k: v for k, v in node.items() if k not in about}, {"$ref": "#/$defs/Variable"}],
    }


def tidy(node: dict[str, Any]) -> dict[str, Any]:
    """Leave out titles, which repeat the keys, nulls for keys left out, and the defaults of whole sections."""
    branches = [branch for branch in node.get("anyOf", ()) if branch != {"type": "null"}]
    if len(branches) == 1:
        node = {**{key: value for key, value in node.items() if key != "anyOf"}, **branches[0]}
    noise = {"title", "default"} if "$ref" in node and isinstance(node.get("default"), dict) else {"title"}
    kept = {
        key: value for key, value in node.items() if key not in noise and (key, value) != ("default", None)
    }
    return {key: _tidy_member(key, value) for key, value in kept.items()}


def _tidy_member(key: str, value: object) -> object:
    if key in {"default", "examples"}:
        return value
    if key == "description":
        return " ".join(str(value).split())
    if key in {"properties", "$defs"}:
        members = cast("dict[str, dict[str, Any]]", value)  # names, not keywords
        return {name: tidy(member) for name, member in members.items()}
    if isinstance(value, dict):
        return tidy(cast("dict[str, Any]", value))
    if isinstance(value, list):
        return [tidy(cast("dict[str, Any]", item)) if isinstance(item, dict) else item for item in value]
    return value
