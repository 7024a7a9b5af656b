"""`ingest` without arguments, and `ingest quickstart`."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from mosaico_ingest.cli.app import main
from mosaico_ingest.cli.manifests import suggestions

DRIVE = Path(__file__).parents[2] / "configs" / "quickstart" / "drive.mcap"


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(arguments)
    return int(end.value.code or 0)


def test_ingest_without_arguments_suggests_commands_for_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(DRIVE, tmp_path / "my drive.mcap")
    monkeypatch.chdir(tmp_path)
    assert run() == 2
    assert "ingest bag 'my drive.mcap'\n" in capsys.readouterr().out
    assert run("bag", "my drive.mcap", "-q") == 0
    assert run() == 2
    assert "  ingest store ls\n" in capsys.readouterr().out


def test_ingest_without_arguments_in_other_folder_prints_help(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "notes.yaml").write_text("a: 1\n")
    monkeypatch.chdir(tmp_path)
    assert run() == 2
    assert "Usage: ingest" in capsys.readouterr().out


def test_suggestions_name_manifests_recordings_and_rosbag2_directories(tmp_path: Path) -> None:
    (tmp_path / "job.yaml").write_text("version: 1\nbag: {path: a.mcap}\n")
    (tmp_path / "broken.yaml").write_bytes(b"\xff\xfe")
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "metadata.yaml").touch()
    (tmp_path / "other.db3.zstd").touch()
    (tmp_path / ".hidden.mcap").touch()
    assert suggestions(tmp_path) == [
        "1 job manifest, job.yaml:",
        "  ingest plan job.yaml",
        "  ingest job.yaml",
        "2 recordings, such as drive:",
        "  ingest inspect drive",
        "  ingest bag drive",
        "  ingest init drive",
    ]


def test_quickstart_writes_a_job_that_runs_and_replaces_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run("quickstart", "here") == 0
    assert run("quickstart", "here") == 2
    assert run("here/quickstart.yaml", "-q") == 0
    assert (tmp_path / "mosaico" / "catalog.sqlite").is_file()
