"""The published schema of adapter files accepts the same files as the model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest

import mosaico_ingest
from mosaico_ingest.adapters.mapping.model import adapter_schema
from mosaico_ingest.job.yaml_source import load_source
from mosaico_ingest.services.schemas import adapter_editor_schema

CATALOG = sorted((Path(mosaico_ingest.__file__).parent / "adapters" / "catalog").glob("*.yaml"))
VALIDATOR = jsonschema.Draft202012Validator(adapter_schema())


def plain(value: Any) -> Any:
    """Return a YAML value as JSON, with text keys."""
    return json.loads(json.dumps(value))


def test_adapter_schema_file_is_up_to_date() -> None:
    path = Path(__file__).parents[2] / "schemas" / "adapter.schema.json"
    assert json.loads(path.read_text("utf-8")) == adapter_editor_schema()


@pytest.mark.parametrize("path", CATALOG, ids=lambda path: path.stem)
def test_adapter_schema_accepts_every_builtin(path: Path) -> None:
    VALIDATOR.validate(plain(load_source(path.read_text("utf-8"), file=path.name).value))


def test_adapter_schema_describes_every_key() -> None:
    schema = adapter_schema()
    for model in [schema, *schema["$defs"].values()]:
        for key, node in model.get("properties", {}).items():
            assert "description" in node or "$ref" in node, key


@pytest.mark.parametrize(
    "text",
    [
        "{version: 1, adapter: A, ros_type: a/b, ontology: T, fields: {}, extra: 1}",
        "{version: 2, adapter: A, ros_type: a/b, ontology: T, fields: {}}",
        "{version: 1, adapter: A, ontology: T, fields: {}}",
        "{version: 1, adapter: A, ros_type: a/b, variants: {c/d: {}}, ontology: T, fields: {}}",
        "{version: 1, adapter: A, ros_type: a/b, ontology: T, fields: {x: [1]}}",
        "{version: 1, adapter: A, ros_type: a/b, ontology: T, fields: {x: {valu: 1}}}",
    ],
)
def test_adapter_schema_rejects_files_that_model_rejects(text: str) -> None:
    assert not VALIDATOR.is_valid(plain(load_source(text, file="a.yaml").value))
