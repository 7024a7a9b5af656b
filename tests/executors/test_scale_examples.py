"""The examples for job arrays do what they say: their shell lines are run, and the shards together are the whole."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.report.model import RunReport

ROOT = Path(__file__).resolve().parents[2]
SCALE = ROOT / "configs" / "scale"
SHARDS = 2

Call = tuple[list[str], dict[str, str]]
"""A command, and the environment it is called in."""


def read(name: str) -> dict[Any, Any]:
    return yaml.safe_load((SCALE / name).read_text())


def slurm(shard: int) -> Call:
    numbers = {"SLURM_ARRAY_TASK_ID": str(shard + 1), "SLURM_ARRAY_TASK_COUNT": str(SHARDS)}
    return ["/bin/sh", str(SCALE / "slurm.sbatch"), "job.yaml"], numbers


def kubernetes(shard: int) -> Call:
    container = read("kubernetes-job.yaml")["spec"]["template"]["spec"]["containers"][0]
    numbers = {"JOB_COMPLETION_INDEX": str(shard), "SHARDS": str(SHARDS)}
    return [*container["command"], *container["args"]], numbers


def matrix(shard: int) -> Call:
    steps = read("github-matrix.yaml")["jobs"]["ingest"]["steps"]
    command = next(step["run"] for step in steps if "ingest run" in step.get("run", ""))
    return ["/bin/sh", "-c", command], {"SHARD": str(shard + 1), "SHARDS": str(SHARDS)}


@pytest.mark.slow
@pytest.mark.parametrize("example", [slurm, kubernetes, matrix], ids=lambda example: example.__name__)
def test_the_shards_together_are_the_whole(example: Callable[[int], Call], tmp_path: Path) -> None:
    for name in "abc":
        shutil.copy(ROOT / "configs" / "quickstart" / "drive.mcap", tmp_path / f"{name}.mcap")
    (tmp_path / "job.yaml").write_text('bag: {path: "*.mcap"}\ntopics: [/imu]\ntarget: {store: store}\n')
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    for shard in range(SHARDS):
        command, numbers = example(shard)
        environment = {**os.environ, "PATH": path, **numbers}
        subprocess.run(command, cwd=tmp_path, env=environment, check=True, capture_output=True, timeout=60)  # noqa: S603 - our own example
    reports = [RunReport.model_validate_json(one.read_text()) for one in tmp_path.glob("run-*.json")]
    assert sorted(one.sequence for report in reports for one in report.recordings) == list("abc")
    assert Store.open(tmp_path / "store").names() == tuple("abc")


def test_the_array_of_slurm_and_the_job_of_kubernetes_count_alike() -> None:
    job = read("kubernetes-job.yaml")["spec"]
    container = job["template"]["spec"]["containers"][0]
    assert job["completionMode"] == "Indexed"
    assert {one["name"]: one["value"] for one in container["env"]}["SHARDS"] == str(job["completions"])
    assert f"#SBATCH --array=1-{job['completions']}\n" in (SCALE / "slurm.sbatch").read_text()


def test_the_matrix_covers_every_shard() -> None:
    ingest = read("github-matrix.yaml")["jobs"]["ingest"]
    shards = ingest["strategy"]["matrix"]["shard"]
    assert shards == list(range(1, len(shards) + 1))
    assert ingest["env"]["SHARDS"] == "${{ strategy.job-total }}"
