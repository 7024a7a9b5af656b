"""The committed schemas are up to date and valid, and accept the files of this repository."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from jsonschema import Draft202012Validator

from mosaico_ingest.cli.app import main
from mosaico_ingest.report.run import RunReport

ROOT = Path(__file__).resolve().parents[2]
SCHEMAS = sorted((ROOT / "schemas").glob("*.schema.json"))


def validator(name: str) -> Draft202012Validator:
    return Draft202012Validator(json.loads((ROOT / "schemas" / f"{name}.schema.json").read_text()))


def test_schema_committed_files_are_up_to_date() -> None:
    with pytest.raises(SystemExit) as leave:
        main(["schema", "--check", str(ROOT / "schemas")])
    assert not leave.value.code


@pytest.mark.parametrize("path", SCHEMAS, ids=lambda path: path.name)
def test_schema_is_valid_and_describes_fields(path: Path) -> None:
    schema = json.loads(path.read_text())
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    Draft202012Validator.check_schema(schema)


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("*.yaml")), ids=lambda path: path.name)
def test_schema_accepts_every_job_of_repository(path: Path) -> None:
    validator("job").validate(yaml.safe_load(path.read_text()))


def test_schema_accepts_every_adapter_of_repository() -> None:
    catalog = (ROOT / "mosaico_ingest" / "adapters" / "catalog").glob("*.yaml")
    for path in [*catalog, *(ROOT / "configs").rglob("adapters/*.yaml")]:
        validator("adapter").validate(yaml.safe_load(path.read_text()))


def test_schema_accepts_written_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    bag = ROOT / "configs" / "quickstart" / "drive.mcap"
    with pytest.raises(SystemExit) as leave:
        main(["bag", str(bag), "--name", "drive", "--report", "out/report.json", "-q"])
    assert not leave.value.code
    text = (tmp_path / "out" / "report.json").read_text()
    validator("report").validate(json.loads(text))
    assert RunReport.model_validate_json(text).exit_code == 0


def test_schema_check_names_stale_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["schema", "job", "--write", str(tmp_path)])
    (tmp_path / "job.schema.json").write_text("{}")
    with pytest.raises(SystemExit) as leave:
        main(["schema", "job", "--check", str(tmp_path)])
    assert leave.value.code == 1
    assert "job.schema.json" in capsys.readouterr().err
