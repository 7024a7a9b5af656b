"""A project folder with the files that the examples of the rule pages name."""

from __future__ import annotations

from pathlib import Path

import pytest

ADAPTER = """\
version: 1
adapter: PackAdapter
ros_type: sensor_msgs/msg/Temperature
ontology: Temperature
fields:
  header: header
  value: temperature
"""

SCHEMA = """\
{"required": ["vehicle"], "properties": {"vehicle": {"type": "string"}}, "additionalProperties": false}
"""

EVENTS = {
    "events": "name,start,end\nturn,+10s,+20s\nstop,+20s,+25s\n",
    "no_end": "name,start\nturn,+10s\n",
    "reversed": "name,start,end\nturn,+20s,+10s\n",
    "overlapping": "name,start,end\nturn,+10s,+20s\nstop,+15s,+25s\n",
}


@pytest.fixture
def project(tmp_path: Path) -> Path:
    for folder in ("data", "msgs", "adapters", ".git"):
        (tmp_path / folder).mkdir()
    (tmp_path / "msgs" / "BatteryPack.msg").write_text("float64 voltage\n")
    (tmp_path / "msgs" / "Cell.msg").write_text("float64 voltage\n")
    (tmp_path / "base.yaml").write_text("on_error: {topic: ignore}\n")
    (tmp_path / "metadata.json").write_text("{}")
    for name, rows in EVENTS.items():
        (tmp_path / f"{name}.csv").write_text(rows)
    (tmp_path / "vehicle.schema.json").write_text(SCHEMA)
    (tmp_path / "broken.schema.json").write_text('{"type": "strin"}')
    (tmp_path / "adapters" / "pack.yaml").write_text(ADAPTER)
    (tmp_path / "adapters" / "pack_v2.yaml").write_text(ADAPTER.replace("PackAdapter", "PackV2Adapter"))
    (tmp_path / "adapters" / "wheel.py").write_text("class WheelAdapter(Base):\n    pass\n")
    return tmp_path
