"""The published JSON Schema and reference page of manifests."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
from manifest_reference import manifest_reference

from mosaico_ingest.job.reference import job_schema
from mosaico_ingest.services.schemas import job_editor_schema

COMMITTED = Path(__file__).parents[2] / "schemas" / "job.schema.json"


def test_job_schema_committed_file_is_current() -> None:
    assert json.loads(COMMITTED.read_text()) == job_editor_schema()


def test_job_schema_is_valid_json_schema() -> None:
    jsonschema.Draft202012Validator.check_schema(job_schema())


def properties(schema: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    for model in [schema, *schema["$defs"].values()]:
        yield from model.get("properties", {}).items()


def test_job_schema_describes_every_key_and_refuses_unknown_keys() -> None:
    schema = job_schema()
    models_by_reference = {f"#/$defs/{name}": model for name, model in schema["$defs"].items()}
    descriptions = {
        key: node.get("description") or models_by_reference[node["$ref"]]["description"]
        for key, node in properties(schema)
    }
    assert all(descriptions.values())
    models = [schema, *(model for model in schema["$defs"].values() if "properties" in model)]
    assert all(model["additionalProperties"] is False for model in models)


def test_job_schema_every_example_is_valid() -> None:
    schema = job_schema()
    for _, node in properties(schema):
        for example in node.get("examples", ()):
            jsonschema.Draft202012Validator({**node, "$defs": schema["$defs"]}).validate(example)


def test_job_schema_variable_is_allowed_for_scalars() -> None:
    manifest = {"bag": {"path": "${A}", "ros_distro": "${B}"}, "target": {"host": "${H}", "port": "${P}"}}
    jsonschema.Draft202012Validator(job_schema()).validate(manifest)


def test_manifest_reference_has_every_key() -> None:
    page = manifest_reference()
    assert [key for key, _ in properties(job_schema()) if f"| `{key}` |" not in page] == []
