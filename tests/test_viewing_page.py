"""docs/viewing.md: its commands and its program run, and it names every option of the commands that it describes."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.main import get_command

from mosaico_ingest.cli.app import command_line
from mosaico_ingest.images import ENCODINGS

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "viewing.md").read_text(encoding="utf-8")
COMMANDS = [line[2:] for line in PAGE.splitlines() if line.startswith("$ ingest ")]
(PROGRAM,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def run(*command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)  # noqa: S603 - commands of the page


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("viewing")
    shutil.copytree(ROOT / "configs", folder / "configs")
    finished = run(sys.executable, "-m", "mosaico_ingest", "configs/quickstart.yaml", "-q", cwd=folder)
    assert finished.returncode == 0, finished.stderr
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_command_of_page_succeeds(project: Path, command: str) -> None:
    finished = run(sys.executable, "-m", "mosaico_ingest", *shlex.split(command)[1:], cwd=project)
    assert finished.returncode == 0, finished.stderr
    out = re.search(r"--(?:out|save|foxglove) (\S+)", command)
    assert out is None or (project / out[1]).stat().st_size > 100


@pytest.mark.slow
def test_program_of_page_runs(project: Path) -> None:
    finished = run(sys.executable, "-c", PROGRAM, cwd=project)
    assert finished.returncode == 0, finished.stderr


def test_page_names_every_command_and_option_of_rows() -> None:
    store = get_command(command_line(["store"])).commands["store"]
    for name in ("head", "tail", "sample", "describe", "plot", "image", "sql"):
        assert f"ingest store {name} " in PAGE
    for option in (o for p in store.commands["head"].params for o in p.opts if o.startswith("--")):
        assert option in PAGE, option


def test_page_names_every_encoding() -> None:
    missing = [
        name
        for name in ENCODINGS
        if "C1" not in name and not re.match(r"bayer_|(rgb|bgr)a?16", name) and f"`{name}`" not in PAGE
    ]
    assert not missing
