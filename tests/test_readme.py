"""What the README shows is what happens: its commands run, its Python runs, its sample finding is a real one."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from mosaico_ingest.destinations.store import Store

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = [line[2:] for line in README.splitlines() if line.startswith("$ ingest ")]
PYTHON = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


def run(*command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)  # noqa: S603 - what the README says


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The examples, with the quickstart run and a recording in the folder."""
    folder = tmp_path_factory.mktemp("readme")
    shutil.copytree(ROOT / "configs", folder / "configs")
    shutil.copy(ROOT / "configs" / "quickstart" / "drive.mcap", folder)
    done = run(
        sys.executable,
        "-m",
        "mosaico_ingest",
        "configs/quickstart.yaml",
        "-q",
        "--report",
        "run.json",
        cwd=folder,
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_the_readme_has_commands_and_python() -> None:
    assert len(COMMANDS) >= 5
    assert len(PYTHON) >= 2
    assert README.count("\n") <= 200


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_runs(project: Path, tmp_path: Path, command: str) -> None:
    shutil.copytree(project, tmp_path, dirs_exist_ok=True)
    if " plan " in command:  # what would happen, before it has
        shutil.rmtree(tmp_path / "mosaico")
    done = run(sys.executable, "-m", "mosaico_ingest", *shlex.split(command)[1:], cwd=tmp_path)
    assert done.returncode == 0, done.stderr


def test_the_listing_is_what_is_printed(project: Path) -> None:
    shown = README.split("$ ingest store ls\n")[1].split("$")[0]
    done = run(sys.executable, "-m", "mosaico_ingest", "store", "ls", cwd=project)
    assert without_sizes(shown) <= without_sizes(done.stdout)


def without_sizes(table: str) -> set[str]:
    """Return the lines of a listing; how large a file is depends on the release of Arrow that wrote it."""
    return {re.sub(r"[\d.]+ kB", "# kB", line.rstrip()) for line in table.splitlines() if line}


def test_python_runs_and_writes_what_it_says(project: Path) -> None:
    for code in PYTHON:
        done = run(sys.executable, "-c", code, cwd=project)
        assert done.returncode == 0, done.stderr
    names = {sequence.name for sequence in Store.open(project / "mosaico").sequences()}
    assert "from_python" in names


def test_the_sample_finding_is_what_is_printed(tmp_path: Path) -> None:
    text = re.search(r"```text\n(job\.yaml.*?)```", README, re.DOTALL)
    assert text is not None
    job = (
        'version: 1\nbag: {path: drive.mcap}\nsequence: {name: x}\ntopic_settings: {"/cam*": {every: two}}\n'
    )
    (tmp_path / "job.yaml").write_text(job)
    done = run(sys.executable, "-m", "mosaico_ingest", "lint", "job.yaml", cwd=tmp_path)
    assert text[1].strip() in done.stdout


def test_every_link_leads_somewhere() -> None:
    for target in re.findall(r"\]\((?!https?://)([^)#]+)", README):
        assert (ROOT / target).exists(), target
