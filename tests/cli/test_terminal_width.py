"""Output in a real (pseudo) terminal of 60 and of 200 columns: every line fits, and no word is broken."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("fcntl", reason="only POSIX systems have pseudo terminals")
from terminal import in_terminal, printed_lines

ROOT = Path(__file__).resolve().parents[2]
TOPICS = ("/camera/image_raw/compressed", "/joint_states", "/lidar/points")
COMMANDS = {
    "ls": ["store", "ls"],
    "show": ["store", "show", "quickstart_drive"],
    "describe": ["store", "describe", "quickstart_drive"],
    "describe topic": ["store", "describe", "quickstart_drive/odom"],
    "head": ["store", "head", "quickstart_drive/odom", "-n", "2", "--flatten"],
    "head without flattening": ["store", "head", "quickstart_drive/lidar/points", "-n", "1"],
    "plot": ["store", "plot", "quickstart_drive/imu", "acceleration"],
    "sql": ["store", "sql"],
    "inspect": ["inspect", "configs/quickstart/drive.mcap"],
    "plan": ["plan", "configs/quickstart.yaml"],
    "report": ["report", "run.json"],
}
LONG = {"inspect", "plan", "report", "show", "describe topic"}
"""Commands that also print sentences, which the terminal wraps."""


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("terminal")
    (folder / "configs").symlink_to(ROOT / "configs")
    manifest = (ROOT / "configs" / "quickstart.yaml").read_text()
    (folder / "configs.yaml").write_text(manifest)
    command = [
        sys.executable,
        "-m",
        "mosaico_ingest",
        "bag",
        "configs/quickstart/drive.mcap",
        "--name",
        "quickstart_drive",
    ]
    arguments = ["--store", "mosaico", "--report", "run.json", "-q"]
    subprocess.run([*command, *arguments], cwd=folder, check=True)  # noqa: S603 - our own code
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("width", [60, 200])
@pytest.mark.parametrize("name", COMMANDS)
def test_command_output_fits_terminal_without_breaking_words(project: Path, name: str, width: int) -> None:
    lines = in_terminal(COMMANDS[name], width, project)
    assert lines
    sentences = (": ", " .. ")
    table = [
        line
        for line in lines
        if name not in LONG or line[:1] == " " or not any(mark in line for mark in sentences)
    ]
    assert max(map(len, table)) <= width, max(table, key=len)
    words = {word.rstrip(",:") for line in lines for word in line.split()}
    if name in {"show", "describe", "inspect", "plan", "report"}:
        assert set(TOPICS) <= words
    if name == "head without flattening":
        assert "is_bigendian" in words
    if name in {"inspect", "plan"}:
        assert {"sensor_msgs/msg/CompressedImage", "CompressedImageAdapter"} <= words


@pytest.mark.slow
def test_wide_terminal_has_one_line_per_topic(project: Path) -> None:
    for name in ("show", "describe", "inspect"):
        lines = in_terminal(COMMANDS[name], 200, project)
        (line,) = [line for line in lines if line.startswith("/joint_states ")]
        assert {"RobotJoint", "500"} <= set(line.split())


@pytest.mark.slow
def test_narrow_terminal_keeps_values_with_their_names(project: Path) -> None:
    lines = in_terminal(COMMANDS["describe"], 60, project)
    at = lines.index("/joint_states")
    assert "rows: 500" in lines[at + 1]
    assert any("rate: 50.0 Hz" in line for line in lines[at + 1 : at + 4])


PROGRESS = """
from mosaico_ingest.cli import progress
from mosaico_ingest.report.events import Expected, RunFinished, RunStarted, RunStatus, TopicProgress

progress.time.monotonic = lambda: 5.0
tally = progress.Tally([1] * 65, started=0.0)
topic = Expected("/imu", "/imu", "sensor_msgs/msg/Imu", "IMUAdapter", "IMU", "", 3200)
with progress.live_display(tally) as observe:
    for at in range(44):
        observe(at, RunStarted(f"drive_{at}", "store", (), 1, (topic,)))
        observe(at, TopicProgress("/imu", read=3200 if at else 0, payload_bytes=20_000_000 if at else 0))
        observe(at, RunFinished(RunStatus.COMPLETED if at else RunStatus.FAILED, 0 if at else 1))
"""


def test_progress_in_terminal_is_the_line_of_the_documentation(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "scale.md").read_text(encoding="utf-8")
    (documented,) = re.findall(r"^44 of 65 recordings.*$", page, re.MULTILINE)
    assert documented in printed_lines(["-c", PROGRESS], 200, tmp_path)


def test_progress_in_narrow_terminal_is_complete(tmp_path: Path) -> None:
    lines = printed_lines(["-c", PROGRESS], 60, tmp_path)
    assert all(len(line) <= 60 for line in lines)
    at = next(at for at, line in enumerate(lines) if line.startswith("44 of 65"))
    assert "2.44 s left" in " ".join(lines[at : at + 3])
