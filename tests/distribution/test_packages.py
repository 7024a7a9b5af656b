"""The wheel and the sdist: their content, and the quickstart in a new environment that contains only the wheel."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

from mosaico_ingest.version import __version__

ROOT = Path(__file__).parents[2]
SCRIPTS = "Scripts" if os.name == "nt" else "bin"

pytestmark = pytest.mark.slow


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command without the checkout on the path, and return its output."""
    environment = {
        name: value for name, value in os.environ.items() if name not in {"PYTHONPATH", "PYTHONHOME"}
    }
    result = subprocess.run(  # noqa: S603 - our own commands
        list(map(str, command)), cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The wheel and the sdist of the checkout."""
    if find_spec("hatchling") is None:
        pytest.skip("hatchling, which builds the packages, is not installed")
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "hatchling", "build", "-d", folder, cwd=ROOT)
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, sdist


def test_packages_pass_the_checks_of_the_index(packages: tuple[Path, Path], tmp_path: Path) -> None:
    for module in ("twine", "check_wheel_contents"):
        if find_spec(module) is None:
            pytest.skip(f"{module} is not installed")
    run(sys.executable, "-m", "twine", "check", "--strict", *packages, cwd=tmp_path)
    run(sys.executable, "-m", "check_wheel_contents", packages[0], cwd=tmp_path)


def test_packages_contain_data_files_and_build_inputs(packages: tuple[Path, Path]) -> None:
    wheel, sdist = packages
    assert wheel.name == f"mosaico_ingest-{__version__}-py3-none-any.whl"
    with zipfile.ZipFile(wheel) as opened:
        names = set(opened.namelist())
    assert {
        "mosaico_ingest/py.typed",
        "mosaico_ingest/adapters/catalog.json",
        "mosaico_ingest/rule_pages/python-refused.md",
        "mosaico_ingest/quickstart/quickstart.yaml",
        "mosaico_ingest/quickstart/quickstart/drive.mcap",
    } <= names
    assert not [name for name in names if name.startswith("tests/") or name.endswith(".pyc")]
    with tarfile.open(sdist) as opened:
        files = {name.partition("/")[2] for name in opened.getnames()}
    assert {"pyproject.toml", "LICENSE", "dev", "docs/rules/python-refused.md", "tests/conftest.py"} <= files


def test_installed_wheel_runs_its_quickstart(packages: tuple[Path, Path], tmp_path: Path) -> None:
    """Check the quickstart; dependencies come from the environment of the tests, so that the test needs no network."""
    environment = tmp_path / "env"
    venv.create(environment, with_pip=False)
    python = environment / SCRIPTS / Path(sys.executable).name
    python = python if python.exists() else environment / SCRIPTS / "python"
    site = Path(
        run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=tmp_path).strip()
    )
    pip = (sys.executable, "-m", "pip", "--python", python, "--disable-pip-version-check")
    run(*pip, "install", "--quiet", "--no-deps", "--no-index", packages[0], cwd=tmp_path)
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"))  # after the wheel on the path
    ingest = environment / SCRIPTS / "ingest"
    where = run(python, "-c", "import mosaico_ingest; print(mosaico_ingest.__file__)", cwd=tmp_path).strip()
    assert Path(where).is_relative_to(site)
    assert run(ingest, "--version", cwd=tmp_path).split() == ["mosaico-ingest", __version__]
    run(ingest, "quickstart", cwd=tmp_path)
    run(ingest, "--no-python", "quickstart/quickstart.yaml", cwd=tmp_path)
    assert "quickstart_drive" in run(ingest, "store", "ls", cwd=tmp_path)
    assert "ING003" in run(ingest, "lint", "--explain", "yaml-tag", cwd=tmp_path)
