"""The action for GitHub and the template for GitLab: their scripts run with bash, and fail when a check fails."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
ACTION: dict[str, Any] = yaml.safe_load((ROOT / "action.yml").read_text())
GITLAB_SPEC, GITLAB_JOBS = yaml.safe_load_all((ROOT / "configs/ci/gitlab.yml").read_text())
STEPS = {step["id"]: step for step in ACTION["runs"]["steps"] if "run" in step}
MANIFEST = "configs/examples/contract.yaml"
VIOLATED = "configs/examples/violated.yaml"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A checkout with the configs, and the command `ingest` in the folder `bin`."""
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    contract = "extends: contract.yaml\ndefinitions: ~\nsequence: {name: violated}\nexpect: {topics: {/imu: {gap: {max: 1 ms}}}}\n"
    (tmp_path / VIOLATED).write_text(contract)
    (tmp_path / "bin").mkdir()
    script = tmp_path / "bin" / "ingest"
    script.write_text(f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} -m mosaico_ingest "$@"\n')
    script.chmod(0o755)
    (tmp_path / "out" / "sarif").mkdir(parents=True)
    return tmp_path


def bash(script: str, project: Path, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """Run a script as GitHub does."""
    path = f"{project / 'bin'}:{os.environ['PATH']}"
    return subprocess.run(  # noqa: S603 - the scripts of this repository
        ["/bin/bash", "--noprofile", "--norc", "-eo", "pipefail", "-c", script],
        cwd=project,
        env={**os.environ, "PATH": path, "FOLDER": str(project / "out"), **environment},
        capture_output=True,
        text=True,
        check=False,
    )


def step(name: str, project: Path, **inputs: str) -> int:
    """Run a step of the action with inputs, and the defaults for the others; return its exit code."""
    defaults = {key: spec.get("default", "") for key, spec in ACTION["inputs"].items()}
    values = {**defaults, **{key.replace("_", "-"): value for key, value in inputs.items()}}
    environment = {"GITHUB_STEP_SUMMARY": str(project / "out" / "summary.md")}
    for variable, template in STEPS[name]["env"].items():
        if match := re.fullmatch(r"\$\{\{ inputs\.([\w-]+) \}\}", template):
            environment[variable] = values[match[1]]
    return bash(STEPS[name]["run"], project, environment).returncode


def test_action_passes_inputs_to_scripts_as_environment_variables() -> None:
    names = set(ACTION["inputs"])
    assert all("${{" not in each["run"] for each in STEPS.values())  # otherwise an input could add commands
    used = set(re.findall(r"inputs\.([\w-]+)", (ROOT / "action.yml").read_text()))
    assert used == names


@pytest.mark.parametrize(("fail_on", "code"), [("warning", 11), ("error", 0)])
def test_action_lint_fails_from_the_chosen_severity(project: Path, fail_on: str, code: int) -> None:
    unused = "  # ingest: ignore[machine-path]"
    (project / "job.yaml").write_text(f"version: 1\nbag: {{path: a.mcap}}{unused}\nsequence: {{name: a}}\n")
    assert step("lint", project, lint="job.yaml", fail_on=fail_on) == code
    assert (project / "out/sarif/lint.sarif").stat().st_size > 100


@pytest.mark.slow
def test_action_plan_check_and_run_pass_for_good_and_fail_for_violated_recordings(project: Path) -> None:
    assert bash(f"ingest plan {MANIFEST} --out plan.json", project, {}).returncode == 0
    assert step("plan", project, plans=f"{MANIFEST}=plan.json\n") == 0
    assert step("plan", project, plans=f"{VIOLATED}=plan.json\n") == 1
    assert step("check", project, check=f"{VIOLATED}\n{MANIFEST}\n") == 6
    assert step("run", project, run=MANIFEST) == 0
    assert "contract" in (project / "out/summary.md").read_text()
    assert step("run", project, run=VIOLATED) == 6
    names = {path.name for path in (project / "out").rglob("*") if path.is_file()}
    assert {"run.json", "run.html", "run.sarif", "check-1.sarif", "check-2.sarif", "check-1.xml"} <= names


def gitlab(name: str, project: Path, **inputs: str) -> int:
    """Run a job of the template with inputs; return its exit code."""
    defaults = {key: spec.get("default", "") for key, spec in GITLAB_SPEC["spec"]["inputs"].items()}
    job = GITLAB_JOBS[name]
    environment = {
        variable: re.sub(r"\$\[\[ inputs\.(\w+) \]\]", lambda match: {**defaults, **inputs}[match[1]], value)
        for variable, value in job["variables"].items()
    }
    return bash("\n".join(job["script"]), project, environment).returncode


@pytest.mark.slow
def test_gitlab_jobs_report_results_and_fail_for_violated_recordings(project: Path) -> None:
    (project / "bad.yaml").write_text("version: 1\nbag: {path: a.mcap}\nsequence: {nam: a}\n")
    assert gitlab("ingest-lint", project, lint="bad.yaml") == 12
    assert gitlab("ingest-plan", project, plans=f"{MANIFEST}=bad.yaml") == 1
    assert gitlab("ingest-check", project, check=VIOLATED) == 6
    assert gitlab("ingest-run", project, run=MANIFEST) == 0
    names = {"ingest-lint.xml", "ingest-check-1.xml", "ingest-run.xml", "run.html", "run.json", "run.md"}
    assert names <= {path.name for path in project.iterdir()}
