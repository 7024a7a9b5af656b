"""The README: its commands and programs run, and its sample output is real output."""

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
CONSOLE = re.findall(r"```console\n(.*?)```", README, re.DOTALL)
COMMANDS = [line[2:] for line in README.splitlines() if line.startswith("$ ingest ")]
PROGRAMS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


def run(*command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)  # noqa: S603 - commands of the README


def ingest(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return run(sys.executable, "-m", "mosaico_ingest", *arguments, cwd=cwd)


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The examples, with the quickstart's sequence in the store and a recording in the folder."""
    folder = tmp_path_factory.mktemp("readme")
    shutil.copytree(ROOT / "configs", folder / "configs")
    shutil.copy(ROOT / "configs" / "quickstart" / "drive.mcap", folder)
    finished = ingest("configs/quickstart.yaml", "-q", "--report", "run.json", cwd=folder)
    assert finished.returncode == 0, finished.stderr
    return folder


def test_readme_is_short_and_has_commands_and_programs() -> None:
    assert len(COMMANDS) >= 5
    assert len(PROGRAMS) >= 2
    assert README.count("\n") <= 200


def test_readme_opens_with_one_command_for_the_job_and_one_for_the_tests() -> None:
    job, tests = CONSOLE[0].splitlines()
    assert re.fullmatch(r"\$ python3 -m venv (\S+) && \1/bin/pip install -q \. && \1/bin/ingest (\S+)", job)
    assert (ROOT / job.split()[-1]).exists()
    assert tests == "$ ./dev check"


def test_readme_activates_the_environment_and_installs_what_its_programs_import() -> None:
    lines = [line for block in CONSOLE for line in block.splitlines()]
    assert "$ source .venv/bin/activate" in lines[2:4]
    installed = next(line for line in lines if line.startswith("$ pip install ")).split()[3:]
    assert installed == ["duckdb", "polars", "pandas"]
    imported = {
        name for code in PROGRAMS for name in re.findall(r"^(?:import|from) (\w+)", code, re.MULTILINE)
    }
    assert imported <= {*installed, "mosaico_ingest", *sys.stdlib_module_names}


@pytest.mark.parametrize("command", COMMANDS)
def test_readme_command_succeeds(project: Path, tmp_path: Path, command: str) -> None:
    shutil.copytree(project, tmp_path, dirs_exist_ok=True)
    if " plan " in command:  # the plan of a job that has not run yet
        shutil.rmtree(tmp_path / "mosaico")
    finished = ingest(*shlex.split(command)[1:], cwd=tmp_path)
    assert finished.returncode == 0, finished.stderr


def test_readme_listing_equals_the_output_of_store_ls(project: Path) -> None:
    listing = README.split("$ ingest store ls\n")[1].split("$")[0]
    output = ingest("store", "ls", cwd=project).stdout
    assert without_sizes(listing) <= without_sizes(output)


def without_sizes(table: str) -> set[str]:
    """Return the lines of a listing without file sizes, which depend on the release of Arrow."""
    return {re.sub(r"[\d.]+ kB", "# kB", line.rstrip()) for line in table.splitlines() if line}


def test_readme_programs_run_and_write_the_sequence_they_name(project: Path) -> None:
    for code in PROGRAMS:
        finished = run(sys.executable, "-c", code, cwd=project)
        assert finished.returncode == 0, finished.stderr
    names = {sequence.name for sequence in Store.open(project / "mosaico").sequences()}
    assert "from_python" in names


def test_readme_sample_finding_equals_the_output_of_lint(tmp_path: Path) -> None:
    sample = re.search(r"```text\n(job\.yaml.*?)```", README, re.DOTALL)
    assert sample is not None
    job = (
        'version: 1\nbag: {path: drive.mcap}\nsequence: {name: x}\ntopic_settings: {"/cam*": {every: two}}\n'
    )
    (tmp_path / "job.yaml").write_text(job)
    assert sample[1].strip() in ingest("lint", "job.yaml", cwd=tmp_path).stdout


def test_readme_pipeline_names_packages_in_the_order_of_the_data() -> None:
    picture = next(line for line in README.splitlines() if line.startswith("job  →"))
    names = [stage.strip() for stage in picture.split("→")]
    assert names == ["job", "rosbag", "decode", "adapters", "destinations", "report"]
    assert all((ROOT / "mosaico_ingest" / name / "__init__.py").exists() for name in [*names, "pipeline"])


def test_readme_links_lead_to_files() -> None:
    for target in re.findall(r"\]\((?!https?://)([^)#]+)", README):
        assert (ROOT / target).exists(), target
