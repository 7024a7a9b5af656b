"""The published schema is the model's, is valid, and describes every key."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema

from mosaico_ingest.job.reference import job_schema, manifest_reference

COMMITTED = Path(__file__).parents[2] / "schemas" / "job.schema.json"


def test_the_committed_schema_is_the_current_one() -> None:
    assert json.loads(COMMITTED.read_text()) == job_schema()


def test_the_schema_is_valid() -> None:
    jsonschema.Draft202012Validator.check_schema(job_schema())


def properties(schema: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    for model in [schema, *schema["$defs"].values()]:
        yield from model.get("properties", {}).items()


def test_every_key_is_described_and_unknown_ones_are_refused() -> None:
    schema = job_schema()
    named = {f"#/$defs/{name}": model for name, model in schema["$defs"].items()}
    told = {
        key: node.get("description") or named[node["$ref"]]["description"] for key, node in properties(schema)
    }
    assert all(told.values())
    models = [schema, *(model for model in schema["$defs"].values() if "properties" in model)]
    assert all(model["additionalProperties"] is False for model in models)


def test_every_example_is_valid() -> None:
    schema = job_schema()
    for _, node in properties(schema):
        for example in node.get("examples", ()):
            jsonschema.Draft202012Validator({**node, "$defs": schema["$defs"]}).validate(example)


def test_a_variable_may_stand_for_anything_but_a_mapping() -> None:
    manifest = {"bag": {"path": "${A}", "ros_distro": "${B}"}, "target": {"host": "${H}", "port": "${P}"}}
    jsonschema.Draft202012Validator(job_schema()).validate(manifest)


def test_the_committed_reference_is_the_current_one() -> None:
    assert (Path(__file__).parents[2] / "docs" / "manifest.md").read_text() == manifest_reference()


def test_the_reference_has_every_key() -> None:
    page = manifest_reference()
    assert [key for key, _ in properties(job_schema()) if f"| `{key}` |" not in page] == []
