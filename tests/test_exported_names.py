"""The names of the package `mosaico_ingest`: they exist, and importing the package loads no heavy modules."""

from __future__ import annotations

import subprocess
import sys

import mosaico_ingest


def test_every_exported_name_exists() -> None:
    for name in mosaico_ingest.__all__:
        assert getattr(mosaico_ingest, name) is not None
    assert mosaico_ingest.__all__ == sorted(mosaico_ingest.__all__)
    assert set(mosaico_ingest._MODULES) == set(mosaico_ingest.__all__) - {
        "APIKeyPermissionEnum",
        "__version__",
    }


def test_api_key_permissions_are_spelled_as_in_the_sdk() -> None:
    permission = mosaico_ingest.APIKeyPermissionEnum
    assert permission.Write is permission("write")
    assert permission.Delete.includes(permission.Write)
    assert len(permission) == 4


def test_unknown_name_raises_attribute_error() -> None:
    assert not hasattr(mosaico_ingest, "Nonsense")


def test_help_imports_no_heavy_modules() -> None:
    code = "import sys; from mosaico_ingest.cli.app import command_line; command_line(); print([m for m in HEAVY if m in sys.modules])"
    heavy = "HEAVY = ('pyarrow', 'rosbags', 'pydantic', 'numpy', 'yaml'); "
    command = [sys.executable, "-c", heavy + code]
    finished = subprocess.run(command, capture_output=True, text=True, check=True)  # noqa: S603 - our own code
    assert finished.stdout.strip() == "[]"


def test_command_imports_no_other_command() -> None:
    code = (
        "import sys; from mosaico_ingest.cli.app import COMMANDS, GROUPS, main\n"
        "try: main(['bag', '--help'])\n"
        "except SystemExit: pass\n"
        "modules = {*COMMANDS.values(), *GROUPS.values()}\n"
        "print([name for name in modules if f'mosaico_ingest.cli.{name}' in sys.modules])"
    )
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603 - our own code
    assert finished.stdout.splitlines()[-1] == "['run']"
