"""`ingest schema` prints, writes and compares; the committed schemas are current and valid."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import pytest
from typer.testing import CliRunner

from mosaico_ingest.cli.app import app

RUN = CliRunner()
COMMITTED = Path(__file__).parents[2] / "schemas"
NAMES = RUN.invoke(app, ["schema"]).stdout.split()


def test_the_committed_schemas_are_current() -> None:
    result = RUN.invoke(app, ["schema", "--check", str(COMMITTED)])
    assert (result.exit_code, result.output) == (0, "")
    assert {path.name for path in COMMITTED.iterdir()} == {f"{name}.schema.json" for name in NAMES}


@pytest.mark.parametrize("name", NAMES)
def test_a_schema_is_valid(name: str) -> None:
    schema = json.loads(RUN.invoke(app, ["schema", name]).stdout)
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    jsonschema.Draft202012Validator.check_schema(schema)


def test_a_schema_that_is_not_current_is_named(tmp_path: Path) -> None:
    assert RUN.invoke(app, ["schema", "--write", str(tmp_path)]).exit_code == 0
    assert RUN.invoke(app, ["schema", "--check", str(tmp_path)]).exit_code == 0
    (tmp_path / "job.schema.json").write_text("{}")
    result = RUN.invoke(app, ["schema", "--check", str(tmp_path)])
    assert result.exit_code == 1
    assert "job.schema.json — run `ingest schema --write" in result.stderr


def test_an_unknown_name_is_a_usage_error() -> None:
    assert RUN.invoke(app, ["schema", "jobs"]).exit_code == 2
