"""Refused adapters in Python: nothing imports them, and lint, plan and run report the same problem."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from mosaico_ingest import api
from mosaico_ingest.adapters import bridge
from mosaico_ingest.adapters.bridge import ROSBridge, installed_adapters, load_adapter_reference
from mosaico_ingest.adapters.python import NO_PYTHON
from mosaico_ingest.cli import app
from mosaico_ingest.errors import AdapterError, ManifestError
from mosaico_ingest.lint.engine import lint_paths

DRIVE = Path(__file__).parents[2] / "configs" / "quickstart" / "drive.mcap"
ADAPTER = "from pathlib import Path\nPath('imported').touch()\nclass Wheel: pass\n"
MANIFEST = """\
bag: {{path: drive.mcap}}
sequence: {{name: drive}}
target: {{store: store}}
adapters: {{{python}load: [wheel.py:Wheel], override: {{/imu: "wheel:Wheel"}}}}
"""
PLACES = [("python-refused", 4, 19), ("python-refused", 4, 53)]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copy(DRIVE, tmp_path)
    (tmp_path / "wheel.py").write_text(ADAPTER)
    (tmp_path / "job.yaml").write_text(MANIFEST.format(python=""))
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv(NO_PYTHON, raising=False)
    return tmp_path


def compile_places(manifest: Path) -> list[tuple[str, int, int]]:
    with pytest.raises(ManifestError) as error:
        api.compile_job(manifest)
    return [(one.rule, one.span.line, one.span.column) for one in error.value.findings if one.span]


def lint_places(manifest: Path) -> list[tuple[str, int, int]]:
    findings = lint_paths([manifest], env={}).findings
    return [
        (one.rule, one.span.line, one.span.column)
        for one in findings
        if one.span and one.rule == "python-refused"
    ]


def test_python_adapter_refused_by_environment_is_reported_and_not_imported(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest = folder / "job.yaml"
    assert lint_places(manifest) == []
    monkeypatch.setenv(NO_PYTHON, "1")
    assert lint_places(manifest) == compile_places(manifest) == PLACES
    assert not (folder / "imported").exists()


def test_python_adapter_refused_by_manifest_is_reported_and_not_imported(folder: Path) -> None:
    manifest = folder / "job.yaml"
    manifest.write_text(MANIFEST.format(python="python: false, "))
    places = [(rule, line, column + 15) for rule, line, column in PLACES]
    assert lint_places(manifest) == compile_places(manifest) == places
    assert not (folder / "imported").exists()


@pytest.mark.parametrize("command", ["run", "plan", "check"])
def test_option_no_python_refuses_the_job(
    folder: Path, command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(NO_PYTHON, "")  # restored after the test
    with pytest.raises(SystemExit) as end:
        app.main([command, str(folder / "job.yaml"), "--no-python"])
    assert end.value.code == 2
    assert "job.yaml:4:19: error[python-refused]" in capsys.readouterr().err
    assert not (folder / "imported").exists()


@pytest.mark.parametrize("reference", ["wheel.py:Wheel", "wheel:Wheel"])
def test_reference_to_python_is_refused_everywhere(
    folder: Path, reference: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(NO_PYTHON, "1")
    with pytest.raises(AdapterError):
        load_adapter_reference(reference, folder)
    with pytest.raises(AdapterError):
        ROSBridge(overrides={"/imu": reference}, base_dir=folder)
    assert not (folder / "imported").exists()


def test_adapters_of_packages_are_not_imported_without_python(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_: str) -> tuple[()]:
        pytest.fail("an installed adapter was looked up")

    monkeypatch.setattr(bridge, "entry_points", refuse)
    bridge._entry_point_adapters.cache_clear()
    assert not ROSBridge(python=False).resolve("/imu", "sensor_msgs/msg/Imu").unmodeled
    monkeypatch.setenv(NO_PYTHON, "1")
    assert installed_adapters() == ()


def test_yaml_adapters_run_without_python(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(NO_PYTHON, "1")
    shutil.copy(DRIVE.parent / "adapters" / "battery_pack.yaml", folder)
    manifest = folder / "job.yaml"
    manifest.write_text("bag: {path: drive.mcap}\nadapters: {load: [battery_pack.yaml]}\n")
    (report,) = api.run(api.compile_job(manifest)).recordings
    assert report.exit_code == 0, json.dumps(report.findings)
