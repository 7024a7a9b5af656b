"""`ingest bag` has every option of the official injector, with the same meaning."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from typer.main import get_command

from mosaico_ingest.cli.app import command_line, main
from mosaico_ingest.destinations.store import Store

DRIVE = Path(__file__).resolve().parents[2] / "configs" / "quickstart" / "drive.mcap"
OFFICIAL_OPTIONS = {
    "--name", "-n", "--dry-run", "--update-if-exists", "--host", "--port", "--topics", "--metadata",
    "--topic-metadata", "--ros-distro", "--api-key", "--tls-cert", "--log", "-l", "--help", "-h",
}  # fmt: skip


def bag(*arguments: str) -> int:
    with pytest.raises(SystemExit) as exited:
        main(["bag", *arguments])
    return int(exited.value.code or 0)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    shutil.copy(DRIVE, tmp_path / "Drive 1.mcap")
    return tmp_path


def test_bag_has_all_options_of_the_official_injector() -> None:
    (command,) = [get_command(command_line(["bag", "run"])).commands["bag"]]
    options = {option for parameter in command.params for option in parameter.opts}
    assert OFFICIAL_OPTIONS - {"--help", "-h"} <= options
    assert {"--help", "-h"} <= set(command.context_settings.get("help_option_names", ["--help", "-h"]))


def test_bag_without_name_uses_stem_of_file() -> None:
    assert bag("Drive 1.mcap", "-q", "--topics", "/imu") == 0
    assert [info.name for info in Store.open("mosaico").sequences()] == ["Drive_1"]


def test_bag_topics_option_takes_several_patterns_in_order() -> None:
    assert bag("Drive 1.mcap", "-n", "d", "-q", "--topics", "/camera/*", "!/camera/image_raw*", "/imu") == 0
    topics = [topic.name for topic in Store.open("mosaico").sequence("d").topics]
    assert topics == ["/camera/camera_info", "/imu"]


def test_bag_metadata_options_accept_json_and_files(folder: Path) -> None:
    (folder / "topics.json").write_text(json.dumps({"/imu": {"unit": "rad/s"}}))
    arguments = ("--metadata", '{"vehicle": "a"}', "--topic-metadata", "topics.json", "--topics", "/imu")
    assert bag("Drive 1.mcap", "-n", "d", "-q", *arguments) == 0
    info = Store.open("mosaico").sequence("d")
    assert info.metadata["vehicle"] == "a"
    assert "rad/s" in str(info.topics[0].metadata)


@pytest.mark.parametrize("value", ["[1]", '{"/imu": 1}', "{", "gone.json"])
def test_bag_invalid_topic_metadata_exits_2_with_option(
    value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bag("Drive 1.mcap", "--topic-metadata", value) == 2
    assert "--topic-metadata" in capsys.readouterr().err
    assert not Path("mosaico").exists()


def test_bag_update_if_exists_adds_topics() -> None:
    assert bag("Drive 1.mcap", "-n", "d", "-q", "--topics", "/imu") == 0
    assert bag("Drive 1.mcap", "-n", "d", "-q", "--topics", "/odom") == 1
    assert bag("Drive 1.mcap", "-n", "d", "-q", "--topics", "/odom", "--update-if-exists") == 0
    assert [topic.name for topic in Store.open("mosaico").sequence("d").topics] == ["/imu", "/odom"]


def test_bag_dry_run_prints_plan_and_writes_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert bag("Drive 1.mcap", "--dry-run", "--host", "127.0.0.1", "--port", "1", "--topics", "/imu") == 0
    output = capsys.readouterr().out
    assert "IMUAdapter" in output
    assert "/odom and 1 more" in output
    assert [path.name for path in Path().iterdir()] == ["Drive 1.mcap"]


def test_bag_report_dash_prints_only_json_to_stdout(capsys: pytest.CaptureFixture[str]) -> None:
    assert bag("Drive 1.mcap", "--topics", "/imu", "--report", "-") == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["exit_code"] == 0
    assert "1,000 messages written" in captured.err
    assert not Path("-").exists()
