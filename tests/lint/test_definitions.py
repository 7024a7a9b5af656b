"""A mistake in a `.msg` file of the job has the same rule, location and severity in lint, plan and run."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_recordings import define, record

from mosaico_ingest.cli.app import main
from mosaico_ingest.errors import DefinitionError
from mosaico_ingest.rosbag.definitions.registry import TypeResolver

JOB = "bag: {path: run.mcap, custom_msgs: [{package: acme_msgs, path: msgs}]}\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    definition = define("acme_msgs/msg/Note", "float64 volts\n")
    record(tmp_path / "run.mcap", [("/note", definition, 1, {"volts": 1.0})])
    (tmp_path / "msgs").mkdir()
    (tmp_path / "job.yaml").write_text(JOB)
    return tmp_path


@pytest.mark.parametrize(
    ("text", "location", "rule"),
    [
        ("# a pack\n\nfloat64 volts\n\n\nflaot32 amps\n", "msgs/Pack.msg:6:1", "msg-unknown-type"),
        ("float64 volts\n  Cell[<=4] cells  # all\n", "msgs/Pack.msg:2:3", "msg-unknown-type"),
        ("float64 volts\nfloat32\n", "msgs/Pack.msg:2:1", "msg-syntax"),
    ],
)
def test_definition_with_mistake_is_reported_alike_by_lint_plan_and_run(
    folder: Path, text: str, location: str, rule: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "msgs" / "Pack.msg").write_text(text)
    expected = f"{location}: error[{rule}]"
    for arguments, exit_code in (
        (["lint", "job.yaml"], 12),
        (["lint", "."], 12),
        (["plan", "job.yaml"], 2),
        (["run", "job.yaml"], 2),
    ):
        with pytest.raises(SystemExit) as stopped:
            main(arguments)
        assert stopped.value.code == exit_code, arguments
        output = "".join(capsys.readouterr())
        assert output.count("error[") == 1
        assert output.startswith(expected), arguments


def test_definition_of_same_package_in_another_entry_is_known(tmp_path: Path) -> None:
    for name, text in (
        ("Pack", "Cell[] cells\nHeader header\ntime stamp\nother_msgs/Foo foo\n"),
        ("Cell", "int8 x\n"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / f"{name}.msg").write_text(text)
    entries = [("acme_msgs", tmp_path / name, None) for name in ("Pack", "Cell")]
    assert TypeResolver(None, entries)
    with pytest.raises(DefinitionError) as raised:
        TypeResolver(None, entries[:1])
    assert [finding.rule for finding in raised.value.findings] == ["msg-unknown-type"]
