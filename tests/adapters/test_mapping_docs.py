"""The documentation of the mapping language: its examples work."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from mosaico_ingest.adapters.mapping.loader import load_adapter
from mosaico_ingest.adapters.standalone import run_tests
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.registry import TypeResolver

TEXT = (Path(__file__).parents[2] / "docs" / "mapping.md").read_text("utf-8")
BLOCKS = re.findall(r"```yaml\n(.*?)```", TEXT, re.DOTALL)

BATTERY_PACK = """\
std_msgs/Header header
uint32 voltage_mv
int32 current_ma
uint8 soc
acme_msgs/Cell[] cells
uint8 status
string serial
"""
TYPES: dict[str, Path | str] = {
    "acme_msgs/msg/BatteryPack": BATTERY_PACK,
    "acme_msgs/msg/Cell": "uint16 voltage_mv\n",
}


def block(start: str) -> str:
    [actual] = [block for block in BLOCKS if block.startswith(start)]
    return actual


@pytest.mark.parametrize("text", [block for block in BLOCKS if block.startswith("version: 1")])
def test_mapping_page_complete_example_passes_its_tests(text: str) -> None:
    outcomes = run_tests(load_adapter(text, file="docs"), TypeResolver(types=TYPES))
    assert outcomes
    assert [(outcome.name, outcome.problems) for outcome in outcomes if outcome.problems] == []


def test_mapping_page_variants_example_binds() -> None:
    spec = load_adapter(f"version: 1\nadapter: A\nontology: Pose\n{block('variants:')}", file="docs")
    for name in spec.ros_types:
        definition = TypeResolver().resolve(name, None, ros_version=2)
        assert spec.check(definition, ros_shape(definition)) == ()


def test_mapping_page_inline_ontology_example_loads() -> None:
    text = f"version: 1\nadapter: A\nros_type: a/msg/B\nfields: {{left: 1}}\n{block('ontology:')}"
    spec = load_adapter(text, file="docs")
    assert (spec.ontology.tag, len(spec.ontology.struct)) == ("WheelTicks", 7)


@pytest.mark.parametrize(
    "key",
    [
        "value",
        "map",
        "else",
        "use",
        "of",
        "fields",
        "with",
        "when",
        "variants",
        "definition",
        "parameters",
        "let",
        "drop_when",
        "rows",
        "outputs",
    ],
)
def test_mapping_page_documents_every_key(key: str) -> None:
    assert f"`{key}`" in TEXT or f"{key}:" in TEXT
