"""docs/adapters.md agrees with the catalog, and its examples work."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from mosaico_ingest.adapters import python as base
from mosaico_ingest.adapters.bridge import ROSBridge, load_adapter_reference
from mosaico_ingest.adapters.builtin import BY_NAME
from mosaico_ingest.job.model import AdapterSettings
from mosaico_ingest.rosbag.blocks import ROSMessage

PAGE = (Path(__file__).parents[2] / "docs" / "adapters.md").read_text("utf-8")


@pytest.fixture(autouse=True)
def _nothing_stays_registered() -> Iterator[None]:
    before = dict(base._registered)
    yield
    base._registered.clear()
    base._registered.update(before)


def _block(language: str) -> str:
    (block,) = re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    return block


def test_adapters_page_names_every_built_in_adapter() -> None:
    assert all(f"| `{name}` |" in PAGE for name in BY_NAME)


def test_adapters_page_python_example_runs(tmp_path: Path) -> None:
    (tmp_path / "wheel.py").write_text(_block("python"))
    assert load_adapter_reference("wheel.py:WheelAdapter", tmp_path).ros_types == ("my_pkg/msg/WheelTicks",)
    message = ROSMessage(1, "/wheel", "my_pkg/WheelTicks", {"left": 3, "right": 4})
    assert ROSBridge.from_ros_message(message).data.model_dump() == {"left": 3, "right": 4}


def test_adapters_page_manifest_example_is_valid() -> None:
    AdapterSettings.model_validate(yaml.safe_load(_block("yaml"))["adapters"])
