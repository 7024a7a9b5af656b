"""The promise of docs/formats.md: files of a newer version are refused and never interpreted."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from typer.testing import CliRunner

from mosaico_ingest.cli.app import command_line
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.destinations.store.catalog import FORMAT
from mosaico_ingest.errors import IngestError, ManifestError, SinkError
from mosaico_ingest.pipeline.definition_changes import LockFile, read_lock
from mosaico_ingest.pipeline.plan_document import read_plan
from mosaico_ingest.report.run import read_report
from mosaico_ingest.serve.guard import Keyring


@pytest.fixture
def documents(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a plan, a lock file, a report and a key file of the current version."""
    monkeypatch.chdir(tmp_path)
    recording = Path(__file__).parents[1] / "configs" / "quickstart" / "drive.mcap"
    Path("job.yaml").write_text(f"version: 1\nbag: {{path: {recording}}}\ntopics: [/imu]\n")
    for words in (
        ["plan", "job.yaml", "--out", "plan.json"],
        ["schema", "lock", "job.yaml"],
        ["run", "job.yaml", "-q", "--report", "report.json"],
        ["keys", "new", "--permission", "read", "--api-keys", "keys.json"],
    ):
        result = CliRunner().invoke(command_line(), words)
        assert result.exit_code == 0, result.output
    return tmp_path


def test_document_of_a_newer_version_is_refused(documents: Path) -> None:
    readers = {
        "plan.json": read_plan,
        "job.lock.json": lambda path: read_lock(LockFile(str(path), path.read_text())),
        "report.json": read_report,
        "keys.json": Keyring,
    }
    for name, read in readers.items():
        path = documents / name
        read(path)
        document = json.loads(path.read_text())
        assert document["version"] == 1, name
        path.write_text(json.dumps({**document, "version": 2}))
        with pytest.raises((ManifestError, SinkError), match="version"):
            read(path)


def test_manifest_and_adapter_of_a_newer_version_are_refused(documents: Path) -> None:
    catalog = Path(__file__).parents[1] / "configs" / "quickstart" / "adapters" / "battery_pack.yaml"
    (documents / "pack.yaml").write_text(catalog.read_text().replace("version: 1", "version: 2"))
    manifest = documents / "job.yaml"
    manifest.write_text(manifest.read_text().replace("version: 1", "version: 2"))
    for name in ("job.yaml", "pack.yaml"):
        result = CliRunner().invoke(command_line(), ["lint", name])
        assert result.exit_code == 12, name
        assert f"{name}:" in result.output
        assert "version" in result.output


def test_store_of_a_newer_format_is_refused_and_unchanged(documents: Path) -> None:
    catalog = documents / "mosaico" / "catalog.sqlite"
    with closing(sqlite3.connect(catalog)) as database:
        database.execute(f"PRAGMA user_version = {FORMAT + 1}")
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    content = catalog.read_bytes()
    for create in (False, True):
        with pytest.raises(
            IngestError, match=f"the store has format {FORMAT + 1}, this version supports up to {FORMAT}"
        ):
            Store.open("mosaico", create=create)
    assert catalog.read_bytes() == content
