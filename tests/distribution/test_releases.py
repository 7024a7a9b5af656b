"""The workflows: they test the platforms that the documentation names, and publish the version of the changelog."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from mosaico_ingest.version import __version__

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[2]
WORKFLOWS = ROOT / ".github" / "workflows"


def workflow(name: str) -> dict[str, Any]:
    return yaml.safe_load((WORKFLOWS / f"{name}.yml").read_text())


def test_support_matrix_equals_the_tested_platforms() -> None:
    rows = re.findall(
        r"^\| [^|]*\(`([\w.-]+)`\) \| ([^|]+) \|", (ROOT / "docs/releases.md").read_text(), re.MULTILINE
    )
    matrix = workflow("check")["jobs"]["platforms"]["strategy"]["matrix"]
    assert [name for name, _ in rows] == matrix["os"]
    assert {versions.strip() for _, versions in rows} == {", ".join(matrix["python"])}


def test_classifiers_name_the_tested_versions_of_python() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    versions = [match[1] for one in project["classifiers"] if (match := re.search(r":: (3\.\d+)$", one))]
    matrix = workflow("check")["jobs"]["platforms"]["strategy"]["matrix"]
    assert versions == matrix["python"]
    assert project["requires-python"] == f">={versions[0]}"


def test_changelog_has_the_section_of_the_version() -> None:
    headings = re.findall(
        r"^## \[([^]]+)\]( - \d{4}-\d\d-\d\d)?$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE
    )
    assert headings[0][0] == "Unreleased"
    assert headings[1][0] == __version__
    assert headings[1][1]


def test_release_publishes_without_a_token_and_attests_its_files() -> None:
    jobs = workflow("release")["jobs"]
    assert jobs["publish"]["permissions"] == {"id-token": "write"}
    actions = {
        step["uses"].partition("@")[0] for job in jobs.values() for step in job["steps"] if "uses" in step
    }
    assert {
        "actions/attest-build-provenance", "actions/attest-sbom", "pypa/gh-action-pypi-publish",
    } <= actions  # fmt: skip
    assert "secrets." not in (WORKFLOWS / "release.yml").read_text()


@pytest.mark.skipif(sys.platform == "win32", reason="./dev needs bash")
@pytest.mark.parametrize("name", ["check", "release"])
def test_workflow_uses_commands_of_dev_that_exist(name: str) -> None:
    lines = re.findall(r"run: \./dev (\w+)", (WORKFLOWS / f"{name}.yml").read_text())
    help_text = subprocess.run([ROOT / "dev", "help"], capture_output=True, text=True, check=True).stdout  # noqa: S603 - our own command
    assert lines
    assert all(f"./dev {command} " in help_text for command in lines)


def test_check_audits_dependencies_and_fuzzes() -> None:
    jobs = workflow("check")["jobs"]
    commands = "\n".join(step.get("run", "") for job in jobs.values() for step in job["steps"])
    assert "pip_audit" in commands
    assert "./dev fuzz 60" in commands
