"""The manifests in configs/r2b with generated stand-ins of the recordings, and the page that describes them."""

from __future__ import annotations

import json
import sqlite3
import sys
from contextlib import closing
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from rosbags.typesys import Stores, get_typestore

from mosaico_ingest import ROSLoader
from mosaico_ingest.cli.app import main
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import IngestError

ROOT = Path(__file__).resolve().parents[1]
MANIFESTS = ROOT / "configs" / "r2b"
SCALE = 0.004
TAGS = {
    "BatteryState": "BatteryState",
    "CameraInfo": "CameraInfo",
    "CompressedImage": "CompressedImage",
    "EncoderTicks": "EncoderTicks",
    "Imu": "IMU",
    "JointState": "RobotJoint",
    "Odometry": "MotionState",
    "PointCloud2": "PointCloud2",
    "TFMessage": "FrameTransform",
}
"""Ontology tag by message type; other kinds are images."""
NAMES = tuple(sorted(path.stem for path in MANIFESTS.glob("*.yaml")))


@pytest.fixture(scope="module")
def r2b() -> ModuleType:
    """The benchmark's module."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        return import_module("r2b")
    finally:
        sys.path.remove(str(ROOT / "benchmarks"))


def ingest(r2b: ModuleType, folder: Path, name: str, patch: pytest.MonkeyPatch) -> Any:
    """Generate the stand-in, run its manifest, and return the report of the recording."""
    r2b.StandIn(r2b.BY_NAME[name]).write(folder, SCALE)
    patch.setenv("R2B", str(folder))
    patch.setenv("R2B_STORE", str(folder / "store"))
    report = folder / "report.json"
    with pytest.raises(SystemExit) as leave:
        main(["run", str(MANIFESTS / f"{name}.yaml"), "-q", "--report", str(report)])
    assert not leave.value.code
    (recording,) = json.loads(report.read_text())["recordings"]
    return recording


def check(r2b: ModuleType, folder: Path, name: str, recording: Any) -> None:
    sequence = r2b.BY_NAME[name]
    expected = {
        (topic.name if topic.name.startswith("/") else f"/{topic.name}"): (
            TAGS.get(topic.kind, "Image"),
            r2b.number_of(topic, sequence, SCALE),
        )
        for topic in sequence.topics
    }
    topics = Store.open(folder / "store").sequence(name).topics
    assert {topic.name: (topic.ontology.tag, topic.rows) for topic in topics} == expected
    assert recording["totals"]["rejected"] == 0


def test_every_sequence_has_a_manifest(r2b: ModuleType) -> None:
    assert set(NAMES) == r2b.BY_NAME.keys()


@pytest.mark.promise("r2b-2024", "r2b-no-adapter")
def test_stand_in_of_2024_is_stored_with_a_topic_without_adapter(
    r2b: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = ingest(r2b, tmp_path, "r2b_whitetunnel", monkeypatch)
    check(r2b, tmp_path, "r2b_whitetunnel", recording)
    ticks = Store.open(tmp_path / "store").scan("r2b_whitetunnel", "/chassis/ticks").read_all()
    assert ticks.column_names == ["timestamp_ns", "header", "left_ticks", "right_ticks", "encoder_timestamp"]


@pytest.mark.promise("r2b-2023")
def test_stand_in_of_2023_with_compressed_messages_and_trailing_bytes_is_stored(
    r2b: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = ingest(r2b, tmp_path, "r2b_cafe", monkeypatch)
    check(r2b, tmp_path, "r2b_cafe", recording)
    with closing(sqlite3.connect(tmp_path / "r2b_cafe" / "r2b_cafe_0.db3")) as database:
        tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        (payload,) = database.execute("SELECT data FROM messages ORDER BY timestamp LIMIT 1").fetchone()
    assert tables == {"topics", "messages"}
    assert payload.startswith(b"\x28\xb5\x2f\xfd")


@pytest.mark.promise("r2b-2023")
def test_stand_in_of_2023_is_refused_by_the_reader_of_the_sdk(r2b: ModuleType, tmp_path: Path) -> None:
    folder = r2b.StandIn(r2b.BY_NAME["r2b_hope"]).write(tmp_path, SCALE)
    with (
        ROSLoader(folder, Stores.ROS2_HUMBLE, reader="rosbags", error_policy="raise") as loader,
        pytest.raises(IngestError),
    ):
        list(loader)
    with ROSLoader(folder, get_typestore(Stores.ROS2_HUMBLE), error_policy="raise") as loader:
        assert [message.data["encoding"] for message, _ in loader] == ["bgr8"]


@pytest.mark.slow
@pytest.mark.promise("r2b-2024", "r2b-2023")
@pytest.mark.parametrize("name", NAMES)
def test_every_stand_in_is_stored_by_its_manifest(
    r2b: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    check(r2b, tmp_path, name, ingest(r2b, tmp_path, name, monkeypatch))


@pytest.mark.slow
@pytest.mark.promise("r2b-results")
def test_benchmark_prints_size_and_time_of_a_stand_in(r2b: ModuleType, tmp_path: Path) -> None:
    (row,) = r2b.results([r2b.BY_NAME["r2b_robotarm"]], tmp_path, SCALE, 1, generate=False)
    name, size, saved, time, *_ = (cell.strip() for cell in row.strip("|").split("|"))
    assert name == "r2b_robotarm"
    assert float(size.split()[0]) == pytest.approx(1496.9 * SCALE, rel=0.2)
    assert 40 < int(saved.split()[0]) < 70
    assert float(time.split()[0]) > 0


def test_page_tables_are_current(r2b: ModuleType) -> None:
    page = (ROOT / "docs" / "r2b.md").read_text()
    table = page.split("<!-- sequences -->")[1].split("<!-- end of sequences -->")[0]
    assert table.strip() == r2b.topic_tables(), "run ./dev docs"
    assert {
        row.split("|")[1].strip() for row in page.split("<!-- results -->")[1].splitlines() if "| r2b_" in row
    } == set(NAMES)
