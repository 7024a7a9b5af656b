"""The examples for PyTorch, Hugging Face datasets, Dagster, Airflow and pre-commit, run with the real packages.

`./dev integrations` installs the packages and runs these tests, which are skipped without them.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from mosaico_ingest import Store, api
from mosaico_ingest.job.model import Job

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "configs" / "integrations"
BROKEN = "/imu: {gap: {max: 1 ms}}\n    /gps/fix: {rate: {min: 4 Hz}}"
pytestmark = pytest.mark.filterwarnings("ignore")  # the other packages emit warnings


def needs(package: str) -> Any:
    reason = f"needs {package}; run ./dev integrations"
    return pytest.mark.skipif(find_spec(package) is None, reason=reason)


def example(name: str) -> Any:
    """Import an example."""
    spec = spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, with the configs of the repository."""
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def drive(project: Path) -> Any:
    """The stored sequence of the quickstart, in the working directory."""
    api.run(api.compile_job(project / "configs" / "quickstart.yaml"))
    return Store.open(project / "mosaico").sequence("quickstart_drive")


def jobs(project: Path, topics: str = "") -> tuple[Job, ...]:
    """Return the jobs of the example of contracts, optionally with other expectations."""
    contract = project / "configs/examples/fleet/expect.yaml"
    if topics:
        contract.write_text(f"expect:\n  recording: {{duration: {{min: 5 s}}}}\n  topics:\n    {topics}\n")
    return api.compile_job(project / "configs/examples/contract.yaml", locked=False)


@needs("torch")
def test_pytorch_example_has_one_sample_per_image(drive: Any, capsys: pytest.CaptureFixture[str]) -> None:
    module = example("pytorch_samples")
    samples = module.ImageAndMotion("mosaico", "quickstart_drive")
    image, motion = samples[7]
    assert (len(samples), tuple(image.shape), str(image.dtype)) == (50, (3, 48, 64), "torch.uint8")
    time = drive.topic("/camera/image_raw/compressed").to_arrow().column("timestamp_ns")[7].as_py()
    odometry = drive.topic("/odom").to_arrow(end=time + 1, flatten=True)
    assert motion[0].item() == pytest.approx(odometry.column("velocity.linear.x")[-1].as_py(), abs=0.05)
    module.main("mosaico", "quickstart_drive")
    assert "50 samples, images (16, 3, 48, 64), motions (16, 3)" in capsys.readouterr().out


@needs("datasets")
def test_huggingface_example_has_ten_samples_per_second(drive: Any, project: Path) -> None:
    module = example("huggingface_dataset")
    module.main("mosaico", drive.name, str(project / "saved"))
    dataset = module.load_from_disk(str(project / "saved"))
    assert dataset.column_names == ["timestamp_ns", "image", "x", "y", "acceleration"]
    times = dataset["timestamp_ns"]
    assert {later - earlier for earlier, later in pairwise(list(times))} == {100_000_000}
    assert (len(dataset), dataset[0]["image"].size) == (99, (64, 48))
    assert all(value is not None for value in dataset["x"])


@needs("dagster")
def test_dagster_example_has_asset_checks_of_the_contract(project: Path) -> None:
    import dagster as dg  # noqa: PLC0415 - the package may be absent

    module = example("dagster_recordings")
    assets = [module.recording_asset(job) for job in jobs(project)]
    for _ in range(2):  # a second materialization replaces the sequence
        result = dg.materialize(assets)
    assert result.success
    checks = {check.check_name: check.passed for check in result.get_asset_check_evaluations()}
    assert checks == {"recording": True, "topic_any": True, "topic_imu": True, "topic_gps_fix": True}
    (materialization,) = result.asset_materializations_for_node("contract")
    assert materialization.metadata["dagster/row_count"].value == 1050
    assert Store.open(project / "mosaico").sequence("contract").rows == 1050


@needs("dagster")
def test_dagster_example_failed_contract_fails_its_check_and_stores_nothing(project: Path) -> None:
    import dagster as dg  # noqa: PLC0415 - the package may be absent

    module = example("dagster_recordings")
    assets = [module.recording_asset(job) for job in jobs(project, BROKEN)]
    result = dg.materialize(assets, raise_on_error=False)
    checks = {check.check_name: check for check in result.get_asset_check_evaluations()}
    assert {name: check.passed for name, check in checks.items()} == {
        "recording": True,
        "topic_imu": False,
        "topic_gps_fix": True,
    }
    assert "10 ms" in checks["topic_imu"].description
    assert not result.success
    assert not result.asset_materializations_for_node("contract")


def run(*command: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(  # noqa: S603 - our own commands
        command, cwd=cwd, capture_output=True, text=True, check=False, env={**os.environ, **environment}
    )


@pytest.mark.slow
@needs("airflow")
def test_airflow_example_ingests_each_recording_and_fails_for_violated_contracts(project: Path) -> None:
    shutil.copy(project / "configs/quickstart/drive.mcap", project / "configs/quickstart/second.mcap")
    script = project / "ingest"
    script.write_text(f'#!/bin/sh\nexec {sys.executable} -m mosaico_ingest "$@"\n')
    script.chmod(0o755)
    environment = {
        "AIRFLOW_HOME": str(project / "airflow"),
        "AIRFLOW__CORE__DAGS_FOLDER": str(EXAMPLES),
        "AIRFLOW__CORE__LOAD_EXAMPLES": "False",
        "INGEST": str(script),
        "INGEST_MANIFEST": str(project / "configs/integrations/nightly.yaml"),
        "INGEST_RECORDINGS": str(project / "configs/quickstart"),
        "PYTHONPATH": str(ROOT),
    }
    airflow = (sys.executable, "-m", "airflow")
    assert run(*airflow, "db", "migrate", cwd=project, **environment).returncode == 0
    finished = run(*airflow, "dags", "test", "nightly_recordings", cwd=project, **environment)
    assert "2 recordings, 2100 messages" in finished.stdout + finished.stderr
    store = Store.open(project / "mosaico")
    assert [sequence.name for sequence in store.sequences()] == ["drive", "second"]
    jobs(project, BROKEN)
    shutil.rmtree(project / "mosaico")
    finished = run(*airflow, "dags", "test", "nightly_recordings", cwd=project, **environment)
    assert "the recording violates its contract" in finished.stdout + finished.stderr
    assert not list(Store.open(project / "mosaico").sequences())


@pytest.mark.slow
@needs("pre_commit")
def test_pre_commit_hooks_report_and_fix_findings(tmp_path: Path) -> None:
    manifest = tmp_path / "job.yaml"
    run("git", "init", "-q", cwd=tmp_path)
    hook = (sys.executable, "-m", "pre_commit", "try-repo", str(ROOT))
    environment = {"PRE_COMMIT_HOME": str(tmp_path / ".cache"), "PYTHONPATH": ""}
    good = "version: 1\nbag: {path: a.mcap}\nsequence: {name: a}\n"
    manifest.write_text(f'{good}topic_settings: {{"/cam*": {{every: two}}}}\n')
    run("git", "add", "job.yaml", cwd=tmp_path)
    finished = run(*hook, "ingest-lint", "--all-files", cwd=tmp_path, **environment)
    assert (finished.returncode, "job.yaml:4:" in finished.stdout) == (1, True)
    manifest.write_text(good)
    run("git", "add", "job.yaml", cwd=tmp_path)
    assert run(*hook, "--all-files", cwd=tmp_path, **environment).returncode == 0
