"""A message that an adapter in Python rejects: its line, index, log time and fields in the report and the quarantine."""

from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from mosaico_ingest.cli.app import main

ADAPTER = """\
from mosaico_ingest import ROSAdapterBase, Serializable


class PySpeed(Serializable):
    value: float


class PySpeedAdapter(ROSAdapterBase[PySpeed]):
    ros_msgtype = "std_msgs/msg/Float64"
    __mosaico_ontology_type__ = PySpeed

    @classmethod
    def from_dict(cls, ros_data):
        return PySpeed(value=ros_data["data"] if ros_data["data"] > 0 else ros_data["speed"])
"""
MANIFEST = """\
version: 1
bag: {path: speed.mcap}
sequence: {name: drive}
adapters: {load: ["speed.py:PySpeedAdapter"], override: {/speed: PySpeedAdapter}}
target: {store: store}
quarantine: {path: rejected}
"""


def test_run_adapter_exception_rejects_one_message_with_its_origin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("speed.py").write_text(ADAPTER)
    Path("job.yaml").write_text(MANIFEST)
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection(
            "/speed", "std_msgs/msg/Float64", msgdef="float64 data", rihs01="RIHS01_" + "0" * 64
        )
        for at, value in enumerate([1.0, 2.0, -1.0, 4.0]):
            writer.write(connection, 100 + at, b"\x00\x01\x00\x00" + struct.pack("<d", value))
    shutil.move(next((tmp_path / "bag").glob("*.mcap")), "speed.mcap")
    with pytest.raises(SystemExit):
        main(["run", "job.yaml", "--report", "report.json"])
    (topic,) = json.loads(Path("report.json").read_text())["recordings"][0]["topics"]
    assert (topic["read"], topic["written"]) == (4, 3)
    (rejection,) = topic["rejections"]
    assert (rejection["rule"], rejection["count"]) == ("adapter-rejected", 1)
    source = str(tmp_path / "speed.py")
    expected = f"PySpeedAdapter: KeyError: 'speed' ({source}:14, message 2, log time 102 ns; fields: data)"
    assert rejection["reason"] == expected
    (line,) = next(Path("rejected").glob("*.jsonl")).read_text().splitlines()
    entry = json.loads(line)
    assert (entry["rule"], entry["log_time_ns"], entry["reason"]) == ("adapter-rejected", 102, expected)
