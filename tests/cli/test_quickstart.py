"""The quickstart, as a user runs it: every topic of the recording is stored with its ontology type."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from rosbags.rosbag2 import Reader

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.report.run import RunReport

ROOT = Path(__file__).resolve().parents[2]
TYPED = {
    "/battery": ("BatteryState", 10),
    "/camera/camera_info": ("CameraInfo", 50),
    "/camera/image_raw/compressed": ("CompressedImage", 50),
    "/gps/fix": ("GPS", 50),
    "/imu": ("IMU", 1000),
    "/joint_states": ("RobotJoint", 500),
    "/lidar/points": ("PointCloud2", 50),
    "/odom": ("MotionState", 200),
    "/tf": ("FrameTransform", 200),
}


def ingest(*arguments: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(  # noqa: S603 - our own command
        [sys.executable, "-m", "mosaico_ingest", *map(str, arguments)],
        cwd=cwd,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the repository's examples after a run of the quickstart."""
    folder = tmp_path_factory.mktemp("project")
    shutil.copytree(ROOT / "configs", folder / "configs")
    finished = ingest("configs/quickstart.yaml", "--report", "report.json", cwd=folder)
    assert finished.returncode == 0, finished.stderr
    return folder


def test_quickstart_stores_every_topic_typed_and_complete(project: Path) -> None:
    topics = Store.open(project / "mosaico").sequence("quickstart_drive").topics
    assert {topic.name: (topic.ontology.tag, topic.rows) for topic in topics} == TYPED


def test_quickstart_report_accounts_for_every_message(project: Path) -> None:
    report = RunReport.model_validate_json((project / "report.json").read_text())
    recording = report.recordings[0]
    assert recording.totals.read == recording.totals.written == sum(count for _, count in TYPED.values())
    assert recording.totals.rejected == 0
    assert {topic.topic for topic in recording.topics if topic.status == "excluded"} == {"/camera/image_raw"}


def test_quickstart_battery_is_converted_by_the_adapter_of_the_job(project: Path) -> None:
    row = Store.open(project / "mosaico").scan("quickstart_drive", "/battery").read_all().to_pylist()[0]
    assert row["voltage"] == pytest.approx(24, abs=0.2)
    assert row["current"] == pytest.approx(-2.4)
    assert row["percentage"] == pytest.approx(0.8)
    assert len(row["cell_voltage"]) == 6
    assert row["power_supply_status"] == 2
    assert row["serial_number"] == "PK-0042"


def test_quickstart_run_twice_fails_because_the_sequence_exists(project: Path) -> None:
    finished = ingest("configs/quickstart.yaml", cwd=project)
    assert finished.returncode == 1
    assert "quickstart_drive" in finished.stderr
    assert "if_exists: skip" in finished.stderr
    assert "Traceback" not in finished.stderr
    assert "/imu" not in finished.stdout, "no table of a run that read nothing"


def test_bag_existing_sequence_is_skipped_or_replaced_with_if_exists(project: Path) -> None:
    command = ("bag", "configs/quickstart/drive.mcap", "--name", "drive", "--store", "again")
    assert ingest(*command, cwd=project).returncode == 0
    result = ingest(*command, cwd=project)
    assert result.returncode == 1
    assert "`ingest bag` has --if-exists" in result.stderr.replace("\n", " ")
    for choice, says in (("skip", "skipped"), ("replace", "2,130 of 2,130 messages written")):
        finished = ingest(*command, "--if-exists", choice, cwd=project)
        assert finished.returncode == 0, finished.stderr
        assert says in finished.stdout + finished.stderr
    refused = ingest(*command, "--if-exists", "maybe", cwd=project)
    assert refused.returncode == 2
    assert "'append'" in refused.stderr


def test_report_of_failed_run_shows_the_error(project: Path) -> None:
    assert ingest("run", "configs/quickstart.yaml", "--report", "failed.json", cwd=project).returncode == 1
    shown = ingest("report", "failed.json", cwd=project)
    assert shown.returncode == 0
    assert "error: quickstart_drive: the sequence already exists" in shown.stdout


def test_store_commands_show_sequences_topics_and_rows(project: Path) -> None:
    listed = json.loads(ingest("store", "ls", "--json", cwd=project).stdout)
    assert [sequence["name"] for sequence in listed] == ["quickstart_drive"]
    shown = ingest("store", "show", "quickstart_drive/imu", cwd=project).stdout
    assert "1,000 rows" in shown
    lines = {line.split()[0]: line.split() for line in shown.splitlines() if line}
    assert lines["acceleration.z"] == ["acceleration.z", "double", "9.81", "9.81", "9.81"]
    assert lines["acceleration.header.*"][1:] == ["3", "columns", "-", "-", "-"]
    assert "_ros_.msgtype: sensor_msgs/msg/Imu" in shown
    sequence = ingest("store", "show", "quickstart_drive", cwd=project).stdout
    assert re.search(r"mosaico_ingest: \S+ from drive\.mcap\n", sequence)


def test_quickstart_recording_equals_the_output_of_its_script(tmp_path: Path) -> None:
    script = ROOT / "configs" / "quickstart" / "make_recording.py"
    subprocess.run([sys.executable, str(script), str(tmp_path / "again.mcap")], check=True)  # noqa: S603 - our own script
    assert content(tmp_path / "again.mcap") == content(ROOT / "configs" / "quickstart" / "drive.mcap")


def content(path: Path) -> str:
    digest = hashlib.sha256()
    with Reader(path) as reader:
        for connection, log_time, data in reader.messages():
            digest.update(f"{connection.topic} {log_time} ".encode() + data)
    return digest.hexdigest()
