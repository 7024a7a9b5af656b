"""Packed jobs contain their adapters, neighboring modules, definitions and certificates, and nothing else."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

from mosaico_ingest.api import compile_job
from mosaico_ingest.cli.app import main
from mosaico_ingest.pipeline.run import make_plan
from mosaico_ingest.pipeline.task import Task

pytest.importorskip("ray", reason="Ray is not installed")

from mosaico_ingest.executors.ray import absolute, pack

QUICKSTART = Path(__file__).resolve().parents[2] / "configs" / "quickstart"
PYTHON = """
from factor import FACTOR
from pressure_units import scale

from mosaico_ingest.adapters import ROSAdapterBase
from mosaico_ingest.ontology import IMU


class Mine(ROSAdapterBase[IMU]):
    ros_msgtype = "sensor_msgs/msg/Imu"
    __mosaico_ontology_type__ = IMU
"""
JOB = """
bag:
  path: ../drives/drive.mcap
  custom_msgs: [{package: acme_msgs, path: ../acme_msgs}]
adapters:
  load: [../adapters/battery_pack.yaml]
  override: {/imu: "imu.py:Mine"}
target: {store: ../store}
"""


@pytest.fixture
def job(tmp_path: Path) -> Path:
    """A manifest with adapters in its own and its parent folder."""
    for folder in ("adapters", "acme_msgs"):
        shutil.copytree(QUICKSTART / folder, tmp_path / "here" / folder)
    jobs = tmp_path / "here" / "jobs"
    (jobs / "pressure_units").mkdir(parents=True)
    (jobs / "pressure_units" / "__init__.py").write_text("from .scale import scale\n")
    (jobs / "pressure_units" / "scale.py").write_text("def scale(): ...\n")
    (jobs / "factor.py").write_text("FACTOR = 2\n")
    (jobs / "imu.py").write_text(PYTHON)
    (jobs / "huge.bin").write_bytes(b"no code")
    (tmp_path / "here" / "drives").mkdir()
    shutil.copy(QUICKSTART / "drive.mcap", tmp_path / "here" / "drives")
    (tmp_path / "here" / "acme_msgs" / "Lamp.idl").write_text(
        "module acme_msgs { module msg { struct Lamp { boolean on; }; }; };"
    )
    (jobs / "job.yaml").write_text(JOB)
    return jobs / "job.yaml"


def test_plan_of_packed_job_is_equal(job: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(job.parent.parent)
    tasks = [Task(one) for one in compile_job(Path("jobs/job.yaml"))]
    planned = make_plan(tasks[0]).document(folder=tasks[0].job.folder)
    (tmp_path / "box").mkdir()
    sent = pack([absolute(task) for task in tasks], tmp_path / "box")
    for name in ("jobs", "adapters", "acme_msgs"):
        shutil.rmtree(tmp_path / "here" / name)
    for name in [name for name in sys.modules if name.startswith(("mosaico_ingest_adapters_", "factor"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.chdir(tmp_path / "box")
    assert make_plan(sent[0]).document(folder=sent[0].job.folder) == planned


def test_pack_copies_only_code_and_definitions(job: Path, tmp_path: Path) -> None:
    (tmp_path / "box").mkdir()
    pack([absolute(Task(one)) for one in compile_job(job)], tmp_path / "box")
    sent = {path.name for path in (tmp_path / "box").rglob("*") if path.is_file()}
    assert sent == {
        ".here",
        "imu.py",
        "factor.py",
        "__init__.py",
        "scale.py",
        "job.yaml",
        "Lamp.idl",
        *(path.name for path in (QUICKSTART / "acme_msgs").rglob("*.msg")),
        *(path.name for path in (QUICKSTART / "adapters").iterdir() if path.suffix == ".yaml"),
    }


def test_ray_not_installed_hints_at_extra(
    job: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.delitem(sys.modules, "mosaico_ingest.executors.ray", raising=False)
    with pytest.raises(SystemExit) as left:
        main(["run", str(job), "--executor", "ray"])
    assert left.value.code == 1
    assert "pip install 'mosaico-ingest[ray]'" in " ".join(capsys.readouterr().err.split())
