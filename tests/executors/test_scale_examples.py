"""The examples in configs/scale: their commands run, and every file, image and volume that they name exists."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.protocol.messages import Permission
from mosaico_ingest.report.run import RunReport
from mosaico_ingest.serve import Keyring

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]
SCALE = ROOT / "configs" / "scale"
SHARDS = 2
RECORDINGS = ("a", "b", "c")

Call = tuple[list[str], dict[str, str]]
"""A command and its environment variables."""


def documents(name: str) -> list[dict[Any, Any]]:
    return list(yaml.safe_load_all((SCALE / name).read_text()))


def kubernetes_job() -> dict[Any, Any]:
    return next(one for one in documents("kubernetes-job.yaml") if one["kind"] == "Job")["spec"]


def container() -> dict[Any, Any]:
    return kubernetes_job()["template"]["spec"]["containers"][0]


def workflow_job() -> dict[Any, Any]:
    return documents("github-matrix.yaml")[0]["jobs"]["ingest"]


def slurm(project: Path, shard: int) -> Call:
    variables = {"SLURM_ARRAY_TASK_ID": str(shard + 1), "SLURM_ARRAY_TASK_COUNT": str(SHARDS)}
    return ["/bin/sh", str(project / "configs/scale/slurm.sbatch")], variables


def kubernetes(project: Path, shard: int) -> Call:
    variables = {
        "JOB_COMPLETION_INDEX": str(shard),
        "SHARDS": str(SHARDS),
        "JOB": str(project / "configs/scale/job.yaml"),
        "STORE": str(project / "store"),
    }
    return [*container()["command"], *container()["args"]], variables


def workflow(project: Path, shard: int) -> Call:
    command = next(step["run"] for step in workflow_job()["steps"] if "ingest run" in step.get("run", ""))
    variables = {"SHARD": str(shard + 1), "SHARDS": str(SHARDS), "STORE": str(project / f"store-{shard}")}
    return ["/bin/sh", "-c", command], variables


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A checkout with three recordings in the folder `recordings`."""
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    (tmp_path / "recordings").mkdir()
    for name in RECORDINGS:
        shutil.copy(ROOT / "configs/quickstart/drive.mcap", tmp_path / "recordings" / f"{name}.mcap")
    return tmp_path


def environment(project: Path) -> dict[str, str]:
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "RECORDINGS": str(project / "recordings")}


@pytest.mark.slow
@pytest.mark.parametrize("example", [slurm, kubernetes, workflow], ids=lambda example: str(example.__name__))
def test_job_array_example_ingests_every_recording_once(
    example: Callable[[Path, int], Call], project: Path
) -> None:
    for shard in range(SHARDS):
        command, variables = example(project, shard)
        subprocess.run(  # noqa: S603 - our own example
            command,
            cwd=project,
            env={**environment(project), **variables},
            check=True,
            capture_output=True,
            timeout=60,
        )
    reports = [RunReport.model_validate_json(path.read_text()) for path in project.glob("run-*.json")]
    assert sorted(one.sequence for report in reports for one in report.recordings) == list(RECORDINGS)
    stores = sorted(project.glob("store-*"))
    assert len(stores) == SHARDS
    assert sorted(name for store in stores for name in Store.open(store).names()) == list(RECORDINGS)


@pytest.mark.slow
def test_systemd_service_example_ingests_the_recordings_of_a_folder(project: Path) -> None:
    service = (SCALE / "ingest-watch.service").read_text()
    command = shlex.split(re.findall(r"^ExecStart=(.*)$", service, re.MULTILINE)[0])
    assert command == ["/srv/ingest/.venv/bin/ingest", "watch", "/data/incoming", "job.yaml"]
    variables = dict(re.findall(r"^Environment=(\w+)=(.*)$", service, re.MULTILINE))
    assert variables == {"STORE": "/srv/ingest/store"}
    shutil.copy(SCALE / "job.yaml", project)
    subprocess.run(  # noqa: S603 - our own example
        ["ingest", "watch", str(project / "recordings"), "job.yaml", "--once", "--rest", "0.1"],  # noqa: S607 - of this environment
        cwd=project,
        env={**environment(project), "STORE": str(project / "store")},
        check=True,
        capture_output=True,
        timeout=60,
    )
    assert Store.open(project / "store").names() == RECORDINGS


def test_slurm_and_kubernetes_examples_have_the_same_number_of_shards() -> None:
    job = kubernetes_job()
    assert job["completionMode"] == "Indexed"
    assert {one["name"]: one["value"] for one in container()["env"]}["SHARDS"] == str(job["completions"])
    assert f"#SBATCH --array=1-{job['completions']}\n" in (SCALE / "slurm.sbatch").read_text()


def test_workflow_example_covers_every_shard() -> None:
    shards = workflow_job()["strategy"]["matrix"]["shard"]
    assert shards == list(range(1, len(shards) + 1))
    assert workflow_job()["env"]["SHARDS"] == "${{ strategy.job-total }}"


def test_workflow_example_installs_the_package_of_its_checkout() -> None:
    for job in documents("github-matrix.yaml")[0]["jobs"].values():
        steps = job["steps"]
        assert steps[0]["uses"].startswith("actions/checkout@")
        assert {"run": "pip install ."} in steps


def test_kubernetes_example_defines_its_volume_and_names_the_image_of_the_dockerfile() -> None:
    claims = [one for one in documents("kubernetes-job.yaml") if one["kind"] == "PersistentVolumeClaim"]
    pod = kubernetes_job()["template"]["spec"]
    assert [one["metadata"]["name"] for one in claims] == [
        volume["persistentVolumeClaim"]["claimName"] for volume in pod["volumes"]
    ]
    image = container()["image"]
    assert f"docker build -t {image} -f configs/scale/Dockerfile ." in (SCALE / "Dockerfile").read_text()


def instructions(name: str) -> list[str]:
    """Return the arguments of the instructions with a name in the last stage of the Dockerfile."""
    stage = (SCALE / "Dockerfile").read_text().rpartition("\nFROM ")[2]
    return [line.partition(" ")[2] for line in stage.splitlines() if line.startswith(f"{name} ")]


def test_dockerfile_example_runs_as_another_user_than_root() -> None:
    (user,) = instructions("USER")
    uid = int(user.partition(":")[0])
    assert uid != 0
    assert any(f"useradd --uid {uid} " in line for line in instructions("RUN"))
    assert kubernetes_job()["template"]["spec"]["securityContext"] == {"fsGroup": uid, "runAsNonRoot": True}


def test_dockerfile_example_serves_and_reports_its_health(tmp_path: Path) -> None:
    (entry,), (default,), (health,) = map(instructions, ("ENTRYPOINT", "CMD", "HEALTHCHECK"))
    program, arguments = json.loads(entry)[0], json.loads(default)
    check = json.loads(health.partition("CMD ")[2])
    assert (program, check[0]) == ("ingest", "ingest")
    python = [sys.executable, "-m", "mosaico_ingest"]
    local = [argument.replace("/data", str(tmp_path)) for argument in arguments]
    local[local.index("--host") + 1] = "127.0.0.1"
    result = subprocess.run([*python, *local], capture_output=True, text=True, check=False)  # noqa: S603 - our own command
    assert result.returncode == 2  # it refuses to serve without keys
    assert "ingest keys new" in result.stderr
    Keyring(tmp_path / "api_keys.json").add(Permission.READ)
    server = subprocess.Popen([*python, *local, "--port", "0"], stdout=subprocess.PIPE, text=True)  # noqa: S603 - our own command
    try:
        assert server.stdout is not None
        port = server.stdout.readline().rpartition(":")[2].strip()
        for port_of_check, code in ((port, 0), ("1", 1)):
            command = [*python, *check[1:], "--port", port_of_check]
            assert subprocess.run(command, check=False).returncode == code  # noqa: S603 - our own command
    finally:
        server.terminate()
        server.communicate(timeout=20)


def test_dockerignore_keeps_all_files_that_the_image_copies() -> None:
    text = (SCALE / "Dockerfile").read_text()
    copies = [
        line.split()[1:-1] for line in text.splitlines() if line.startswith("COPY ") and "--from" not in line
    ]
    kept = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert {source for sources in copies for source in sources} == kept


def test_dockerfile_example_copies_existing_files_and_all_that_the_build_needs() -> None:
    lines = (SCALE / "Dockerfile").read_text().splitlines()
    copies = [line.split()[1:] for line in lines if line.startswith("COPY ") and "--from" not in line]
    sources = {source for *names, _ in copies for source in names}
    assert all((ROOT / source).exists() for source in sources)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    needed = {
        "pyproject.toml",
        project["project"]["readme"],
        *project["project"]["license-files"],
        *wheel["packages"],
        *wheel["force-include"],
    }
    assert needed <= sources
    job = {one["name"]: one["value"] for one in container()["env"]}["JOB"]
    assert ["configs/scale/job.yaml", job] in copies
