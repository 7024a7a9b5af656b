"""Commands on recordings do not import pandas or, without a manifest, the YAML parser, which would slow down their start."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

DRIVE = Path(__file__).parents[2] / "configs" / "quickstart" / "drive.mcap"
PROGRAM = """
import sys
from mosaico_ingest.cli.app import main
try:
    main(sys.argv[1:])
except SystemExit as end:
    assert not end.code, end.code
print("yaml" in sys.modules)
print("pandas" in sys.modules)
import pandas, pyarrow
print(len(pyarrow.array([1]).to_pandas()))
"""


@pytest.mark.slow
@pytest.mark.parametrize("command", ["run", "bag", "inspect", "plan"])
def test_commands_do_not_import_pandas_or_yaml_but_leave_pandas_importable(
    command: str, tmp_path: Path
) -> None:
    pytest.importorskip("pandas")
    job = tmp_path / "job.yaml"
    job.write_text(
        f"version: 1\nbag: {{path: {DRIVE}}}\nsequence: {{name: drive}}\ntarget: {{store: store}}\n"
    )
    arguments = {
        "run": [str(job), "-q"],
        "bag": [str(DRIVE), "--name", "drive", "--store", str(tmp_path / "store"), "-q"],
        "inspect": [str(DRIVE)],
        "plan": [str(job)],
    }
    run = subprocess.run(  # noqa: S603 - our own program
        [sys.executable, "-c", PROGRAM, command, *arguments[command]],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    uses_manifest = str(job) in arguments[command]
    assert run.stdout.split()[-3:] == [str(uses_manifest), "False", "1"]


@pytest.mark.slow
def test_worker_processes_do_not_import_pandas(tmp_path: Path) -> None:
    mark = tmp_path / "imported"
    fake = tmp_path / "modules" / "pandas.py"
    fake.parent.mkdir()
    fake.write_text(f"open({str(mark)!r}, 'w').close()\nraise ImportError\n")
    for name in ("a", "b"):
        shutil.copy(DRIVE, tmp_path / f"{name}.mcap")
    job = tmp_path / "job.yaml"
    job.write_text(
        'version: 1\nbag: {path: "*.mcap", group: none}\nsequence: {name: "{stem}"}\ntarget: {store: store}\n'
    )
    paths = os.pathsep.join([str(fake.parent), os.environ.get("PYTHONPATH", "")])
    subprocess.run(  # noqa: S603 - our own program
        [sys.executable, "-m", "mosaico_ingest", str(job), "-q", "--jobs", "2"],
        env={**os.environ, "PYTHONPATH": paths},
        check=True,
    )
    assert not mark.exists()
