"""`ingest lint`: its text, exit codes and usage errors."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from mosaico_ingest.cli.app import command_line

RUN = CliRunner()
JOB = "bag:\n  path: x.mcap\n  ros_distro: humble\ntopics:\n  - !/cam/*\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "job.yaml").write_text(JOB)
    return tmp_path


def test_lint_text_format_prints_findings_with_excerpts(folder: Path) -> None:
    result = RUN.invoke(command_line(), ["lint", "job.yaml", "--quiet"])
    assert result.exit_code == 12
    assert result.stdout == (
        "job.yaml:3:15: error[wrong-value] bag.ros_distro cannot be 'humble'\n"
        "  |\n"
        "3 |   ros_distro: humble\n"
        "  |               ^^^^^^\n"
        "  = help: did you mean 'ros2_humble'? allowed: empty, latest, ros1_noetic, ros2_dashing, ros2_eloquent, "
        "ros2_foxy, ros2_galactic, ros2_humble, ros2_iron, ros2_jazzy, ros2_kilted, ros2_lyrical\n"
        "\n"
        "job.yaml:5:5: error[yaml-tag] an unquoted ! starts a YAML tag\n"
        "  |\n"
        "5 |   - !/cam/*\n"
        "  |     ^^^^^^^\n"
        '  = help: quote it: "!/cam/*"\n'
    )
    assert folder


def test_lint_fix_applies_all_changes(folder: Path) -> None:
    result = RUN.invoke(command_line(), ["lint", "--fix", "job.yaml"])
    assert (result.exit_code, result.stdout) == (0, "")
    assert "1 file, 0 findings, 2 changes made" in result.stderr
    assert '"!/cam/*"' in (folder / "job.yaml").read_text()


def test_lint_sarif_with_findings_exits_0(folder: Path) -> None:
    result = RUN.invoke(command_line(), ["lint", "--format", "sarif", "job.yaml"])
    assert result.exit_code == 0
    assert json.loads(result.stdout)["version"] == "2.1.0"
    assert folder


def test_lint_dash_reads_stdin(folder: Path) -> None:
    result = RUN.invoke(command_line(), ["lint", "-", "--format", "github"], input=JOB)
    assert result.stdout.startswith("::error file=-,line=3,col=15")
    assert folder


def test_lint_no_env_ignores_unset_variables(folder: Path) -> None:
    (folder / "job.yaml").write_text("bag: {path: '${NOT_SET_ANYWHERE}'}\n")
    assert RUN.invoke(command_line(), ["lint", "job.yaml"]).exit_code == 12
    assert RUN.invoke(command_line(), ["lint", "job.yaml", "--no-env"]).exit_code == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "give a file or a folder"),
        (["nowhere.yaml"], "nowhere.yaml does not exist"),
        (["job.yaml", "--format", "xml"], "'xml' is not one of"),
        (["--explain", "yaml-tga"], "did you mean 'yaml-tag'"),
    ],
)
def test_lint_invalid_arguments_exit_2(folder: Path, arguments: list[str], words: str) -> None:
    result = RUN.invoke(command_line(), ["lint", *arguments], env={"COLUMNS": "200"})
    assert result.exit_code == 2
    assert words in " ".join(result.stderr.split())
    assert folder


def test_lint_skipped_files_are_counted_and_listed(folder: Path) -> None:
    (folder / "compose.yaml").write_text("services: {}\n")
    result = RUN.invoke(command_line(), ["lint", "."], env={"COLUMNS": "200"})
    assert "1 file, 2 findings\n1 file skipped (not a manifest or an adapter): compose.yaml" in result.stderr
    assert json.loads(RUN.invoke(command_line(), ["lint", ".", "--format", "json"]).stdout)["skipped"] == [
        {"file": "compose.yaml", "reason": "not a manifest or an adapter"}
    ]


def test_lint_without_files_exits_3(folder: Path) -> None:
    (folder / "job.yaml").unlink()
    assert RUN.invoke(command_line(), ["lint", "."]).exit_code == 3


@pytest.mark.parametrize("word", ["yaml-tag", "ING003"])
def test_lint_explain_prints_page_of_rule(word: str) -> None:
    result = RUN.invoke(command_line(), ["lint", "--explain", word])
    assert result.stdout.startswith("# yaml-tag (ING003)\n")
    assert "| ING003 | [yaml-tag]" in RUN.invoke(command_line(), ["lint", "--explain", "all"]).stdout
