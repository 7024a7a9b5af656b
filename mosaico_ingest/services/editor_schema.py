"""JSON Schemas of manifests and adapter files for editors, with the known adapters and ontology tags as proposals."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

from mosaico_ingest.adapters.adapter import UnmodeledSpec
from mosaico_ingest.adapters.builtin import BY_NAME
from mosaico_ingest.adapters.mapping.inline_ontology import PLAIN_TYPES
from mosaico_ingest.adapters.mapping.model import adapter_schema
from mosaico_ingest.job.reference import job_schema
from mosaico_ingest.ontology.registry import MODULES


def job_editor_schema() -> dict[str, Any]:
    """Return the JSON Schema of manifests that proposes the names of the built-in adapters."""
    schema = _copy(job_schema())
    override = schema["$defs"]["AdapterSettings"]["properties"]["override"]
    override["additionalProperties"] = _proposing(
        override["additionalProperties"], [*BY_NAME, UnmodeledSpec().name]
    )
    return schema


def adapter_editor_schema() -> dict[str, Any]:
    """Return the JSON Schema of adapter files that proposes ontology tags, types and the names of built-in adapters."""
    schema = _copy(adapter_schema())
    definitions = schema["$defs"]
    for owner in (schema, definitions["Output"]):
        branches = owner["properties"]["ontology"]["oneOf"]
        branches[0] = _proposing(branches[0], MODULES)
    for owner, key, names in (
        ("ValueForm", "use", BY_NAME),
        ("FieldDeclaration", "type", [*PLAIN_TYPES, *MODULES]),
    ):
        properties = definitions[owner]["properties"]
        properties[key] = _proposing(properties[key], names)
    return schema


def _proposing(node: dict[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """Return a schema of texts that proposes some of them; any other text stays valid."""
    about = {key: node[key] for key in ("description", "default") if key in node}
    accepts = {key: value for key, value in node.items() if key not in about}
    return {**about, "anyOf": [{"enum": list(names)}, accepts]}


def _copy(schema: dict[str, Any]) -> dict[str, Any]:
    return json.loads(json.dumps(schema))
