"""The limits in SECURITY.md equal the limits of the code, and none is missing."""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path

import pytest

from mosaico_ingest.job.model import Job
from mosaico_ingest.lint.check import JobSettings

ROOT = Path(__file__).parents[2]
PACKAGES = ("job", "rosbag", "decode", "protocol", "serve", "metadata", "adapters")
"""The packages and modules that process untrusted input."""
INTERNAL = {
    "job.expect._MAX_COUNT": "a bound of a number",
    "job.fields._MAX_COUNT": "a bound of a number",
    "job.yaml_source._MAX_RECOVERIES": "number of reported mistakes",
    "rosbag.blocks.MAX_GROUP_LENGTH": "size of batches",
    "rosbag.blocks._MAX_ELEMENT_BYTES": "the choice of an algorithm",
    "rosbag.blocks._MAX_WORD_BYTES": "the choice of an algorithm",
    "rosbag.compression._MAX_BUFFER_BYTES": "size of batches",
    "rosbag.definitions.model._MAX_SIZE": "a bound of a number",
    "rosbag.encodings.json_messages._MAX_REASON": "length of a text",
    "rosbag.mcap.writer._MAX_CHANNELS": "a limit of the format",
    "rosbag.recording._MAX_ROWS": "size of batches",
    "rosbag.recording._MAX_SLICE_BYTES": "size of batches",
    "rosbag.recording._MAX_SLICES": "size of batches",
    "rosbag.ros1.reader._MAX_CHUNKS": "size of batches",
    "rosbag.ros1.reader._MAX_LAYOUTS": "size of a cache",
    "rosbag.serialization._MAX_EMPTY": "a check of lengths",
    "rosbag.serialization._MAX_PADDING": "alignment",
    "rosbag.serialization._MAX_ZEROS": "alignment",
    "rosbag.source._MAX_GAP_BYTES": "size of requests",
    "rosbag.sqlite._MAX_BITMAP_ROWS": "the choice of an algorithm",
    "rosbag.sqlite._MAX_PAGE_ROWS": "size of batches",
    "rosbag.sqlite._MAX_ROWID": "a limit of the format",
    "decode.layout._MAX_ALIGN": "alignment",
    "serve.guard._MAX_TEXT": "length of a text",
    "metadata._MAX_CHOICES": "length of a text",
    "metadata._MAX_MESSAGE": "length of a text",
    "adapters.mapping.loader._MAX_CACHED_BINDINGS": "size of a cache",
    "rosbag.recording._MAX_READERS": "number of threads",
}
"""Constants that do not limit the cost of input, with the reason."""


def documented() -> dict[str, tuple[str, str]]:
    """Return the value and the key of each constant in the table."""
    rows = [line.split("|")[1:-1] for line in (ROOT / "SECURITY.md").read_text().splitlines()]
    cells = [[cell.strip() for cell in row] for row in rows if len(row) == 4 and ".MAX" not in row[0]]
    return {
        constant.strip("`"): (value, key) for _, value, key, constant in cells if constant.startswith("`")
    }


def number(text: str) -> int:
    value, _, unit = text.partition(" ")
    return int(value.replace(",", "")) * {"": 1, "MiB": 1 << 20}[unit]


@pytest.mark.parametrize(("constant", "value"), [(name, value) for name, (value, _) in documented().items()])
def test_documented_limit_equals_the_code(constant: str, value: str) -> None:
    module, _, name = constant.rpartition(".")
    assert getattr(import_module(f"mosaico_ingest.{module}"), name) == number(value)


def test_every_limit_of_the_code_is_documented() -> None:
    constants: set[str] = set()
    for path in (ROOT / "mosaico_ingest").rglob("*.py"):
        parts = path.relative_to(ROOT / "mosaico_ingest").with_suffix("").parts
        module = ".".join(parts).removesuffix(".__init__")
        if parts[0] in PACKAGES:
            constants |= {f"{module}.{name}" for name in _constants(path) if "MAX" in name}
    assert constants - documented().keys() == INTERNAL.keys()


def test_documented_keys_exist() -> None:
    keys = [key.strip("`") for _, key in documented().values() if key]
    options = (ROOT / "docs" / "cli.md").read_text()
    for key in keys:
        command, _, option = key.partition(" --")
        if option:
            assert command == "serve"
            assert f"--{option}" in options
            continue
        section, _, field = key.partition(".")
        assert section in {*JobSettings.model_fields, *Job.model_fields, "extends", "matrix"}
        if field:
            assert field in JobSettings.model_fields[section].annotation.model_fields  # type: ignore[union-attr] - sections are models


def _constants(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        flat = [
            each
            for target in targets
            for each in (target.elts if isinstance(target, ast.Tuple) else [target])
        ]
        names |= {each.id for each in flat if isinstance(each, ast.Name)}
    return names
