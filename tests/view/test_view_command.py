"""`ingest view`: the Rerun file has an entity for everything that is shown, and Foxglove's file the messages."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from typer.testing import CliRunner

import mosaico_ingest
from mosaico_ingest.cli.app import command_line
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.view.rerun_recording import ViewedTopic, send_sequence, spaces


@pytest.fixture
def output(quickstart: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Return the function that runs `ingest view` in an empty folder and returns its output or its error."""
    monkeypatch.chdir(tmp_path)

    def run(*words: str, code: int = 0) -> str:
        arguments = ["view", "quickstart_drive", *words, "--store", str(quickstart.path)]
        result = CliRunner().invoke(command_line(["view"]), arguments)
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            assert code, result.exception
            return str(result.exception)
        assert result.exit_code == code, result.output
        return result.output

    return run


def entities(path: Path) -> str:
    """Return what Rerun's own tool prints about a file."""
    command = [sys.executable, "-m", "rerun", "rrd", "print", "-vv", str(path)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout  # noqa: S603 - Rerun's tool


@pytest.mark.slow
def test_view_save_writes_entities_of_every_kind(output: Callable[..., str]) -> None:
    lines = [line.split() for line in output("--save", "x.rrd").splitlines()]
    shown = {line[0]: " ".join(line[2:]) for line in lines if line[0].startswith("/")}
    assert shown["/camera/image_raw/compressed"] == "image"
    assert shown["/gps/fix"] == "map, plot"
    assert shown["/lidar/points"] == "points"
    assert shown["/odom"] == "trajectory, plot"
    assert shown["/tf"] == "transforms"
    text = entities(Path("x.rrd"))
    for entity in (
        "/gps/fix/track",
        "/odom/position",
        "/tf/base_link",
        "/imu/plot/acceleration.x",
        "/lidar/points",
    ):
        assert f"{entity}" in text, entity
    assert "index_name: time " in text  # the SDK adds `log_time`, the time of the call


@pytest.mark.slow
def test_view_selects_topics_and_time(output: Callable[..., str]) -> None:
    assert "/odom" not in output("--topics", "/imu", "--save", "imu.rrd")
    output("--topics", "/camera/image_raw/*", "--from", "+1s", "--until", "+2s", "--save", "short.rrd")
    output("--topics", "/camera/image_raw/*", "--save", "long.rrd")
    assert Path("short.rrd").stat().st_size < Path("long.rrd").stat().st_size / 3


def test_view_foxglove_writes_messages_of_ros(output: Callable[..., str]) -> None:
    text = output("--foxglove", "x.mcap", "--topics", "/gps/*", "--topics", "/tf")
    assert "wrote x.mcap: 250 messages" in text
    kinds = {topic.topic: topic.msgtype for topic in mosaico_ingest.inspect("x.mcap").topics}
    assert kinds == {"/gps/fix": "sensor_msgs/msg/NavSatFix", "/tf": "tf2_msgs/msg/TFMessage"}


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["--save", "x.rrd", "--foxglove", "x.mcap"], 2),
        (["--save", "old.rrd"], 2),
        (["--topics", "/nothing", "--save", "x.rrd"], 3),
        (["--from", "noon", "--save", "x.rrd"], 2),
    ],
)
def test_view_wrong_usage_writes_nothing(output: Callable[..., str], words: list[str], code: int) -> None:
    Path("old.rrd").write_bytes(b"old")
    output(*words, code=code)
    assert [path.name for path in Path().iterdir()] == ["old.rrd"]
    assert Path("old.rrd").read_bytes() == b"old"


def test_view_without_rerun_names_the_extra(
    output: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert "mosaico-ingest[view]" in output("--save", "x.rrd", code=1)


def test_spaces_of_quickstart_are_those_of_its_trees_of_frames(quickstart: Store) -> None:
    """The frame of the lidar is not connected with that of the odometry, so one space cannot show both."""
    viewed = []
    for name, kind, frame in (
        ("/odom", "trajectory", "odom"),
        ("/lidar/points", "points", "lidar"),
        ("/tf", "transforms", None),
    ):
        each = ViewedTopic(quickstart.sequence("quickstart_drive").topic(name))
        each.kinds.append(kind)
        each.frames.update({frame: None} if frame else {})
        viewed.append(each)
    assert spaces(viewed) == {"odom": ["/tf/base_link", "/odom/**"], "lidar": ["/lidar/points/**"]}


LOG = OntologyType(
    "Unmodeled", pa.struct([("level", pa.uint8()), ("name", pa.string()), ("msg", pa.string())])
)
FRAME = OntologyType("CompressedImage", pa.struct([("data", pa.binary()), ("format", pa.string())]))


@pytest.mark.slow
def test_send_sequence_counts_rows_that_cannot_be_shown(make_store: Any, tmp_path: Path) -> None:
    rows = [
        {"timestamp_ns": 1, "data": b"no image", "format": "jpeg"},
        {"timestamp_ns": 2, "data": b"\0\0\0\1video", "format": "h264"},
    ]
    logs = [{"timestamp_ns": 1, "level": 20, "name": "n", "msg": "m"}]
    store = make_store({"/camera": (FRAME, rows), "/rosout": (LOG, logs)})
    camera, rosout = send_sequence(store.sequence("made"), save=tmp_path / "x.rrd")
    assert list(camera.problems.values()) == [1]
    assert rosout.kinds[0] == "logs"
