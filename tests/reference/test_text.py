"""The reference text itself: its programs, commands, tables and names, with `mosaicolabs` replaced by this package.

The text is no part of the repository. `test_programs.py`, `test_types.py` and the other modules of this folder test the same
promises in their own words and always run.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
import runpy
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag2 import StoragePlugin
from sample_project import write_recording

import mosaico_ingest
from mosaico_ingest import models, ros_bridge
from mosaico_ingest.cli.app import main
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.ontology import Serializable
from mosaico_ingest.ros_bridge import ROSBridge, ROSTypeRegistry, adapters

_START = re.compile(r"(?:from [\w.]+ import|import \w+|# \w+\.py$)")
_PROSE = re.compile(r"[A-Z•]")
_TYPE = re.compile(r"(?P<package>\w+)/msg/(?P<names>\w+(?:\([\d,]+\))?(?:, \w+)*)(?P<more>\.\.\.)?")
MISSING_COMMA = ("SessionLevelErrorPolicy.Report #", "SessionLevelErrorPolicy.Report, #")
"""The first program is no Python as printed: a comma is missing. This is the only repair."""
PLACEHOLDERS = """
from mosaico_ingest.models import Serializable


class MyCustomData(Serializable):
    mode: int = 0

    def __init__(self, *values: object, **fields: object) -> None:
        super().__init__(**fields)


class MyLidar(Serializable):
    points: int = 0
"""
"""The ontology of the programs; they construct its classes without values, or with an ellipsis."""
NOT_OURS = {
    "MosaicoClient": "the connection of the official SDK; here, the destination opens it",
    "MyCustomAdapter": "of the program",
    "MyCustomLidarAdapter": "of the program",
    "MyCustomRGBDAdapter": "of the program",
    "_GenericStdAdapter": "private; here, each std_msgs type has an adapter of its own",
}


@pytest.fixture(scope="module")
def text(shared: Path) -> str:
    return (shared / "reference" / "ros_bridge.txt").read_text().replace("mosaicolabs", "mosaico_ingest")


def programs(text: str) -> list[str]:
    """Return the Python programs of the text: from an import to the next line of prose."""
    blocks: list[list[str]] = []
    block: list[str] | None = None
    for line in text.splitlines():
        if block is None and _START.match(line):
            blocks.append(block := [])
        elif block is not None and _PROSE.match(line):
            block = None
        if block is not None:
            block.append(line)
    return ["\n".join(block).replace(*MISSING_COMMA) + "\n" for block in blocks]


def program_with(text: str, words: str) -> str:
    (program,) = [program for program in programs(text) if words in program]
    return program


def run_module(folder: Path, name: str, source: str, **variables: Any) -> dict[str, Any]:
    """Run a program as the main module of the package `program`, so that relative imports work."""
    package = folder / "program"
    package.mkdir(exist_ok=True)
    (package / f"{name}.py").write_text(source)
    return runpy.run_module(f"program.{name}", variables, run_name="__main__")


@pytest.fixture
def placeholders(project: Path) -> Path:
    """The project with an ontology whose classes need no values."""
    (project / "my_ontology.py").write_text(PLACEHOLDERS)
    return project


def tags(sequence: str) -> dict[str, str]:
    topics = Store.open(Path("mosaico")).sequence(sequence).topics
    return {topic.name: topic.ontology.tag for topic in topics}


def test_text_has_six_python_programs(text: str) -> None:
    assert [len(program.splitlines()) > 5 for program in programs(text)] == [True] * 6
    for program in programs(text):
        ast.parse(program)


def test_text_first_program_stores_the_camera_topics(
    project: Path, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write_recording(project / "data" / "session_01.db3", StoragePlugin.SQLITE3)
    program = program_with(text, "def run_injection")
    rgbd = type("MyCustomRGBDAdapter", (adapters.RGBDCameraAdapter,), {})
    run_module(project, "injection", program, MyCustomRGBDAdapter=rgbd)
    assert capsys.readouterr().out == "Injection job completed successfully.\n"
    assert tags("test_ros_sequence") == {
        "/camera/depth/points": "RGBDCamera",
        "/camera/front/image": "Image",
        "/camera/status": "Status",
    }


def test_text_custom_adapter_is_registered(placeholders: Path, text: str) -> None:
    program = program_with(text, "class MyCustomAdapter")
    run_module(placeholders, "custom", program)
    adapter = ROSBridge.get_default_adapter("my_pkg/msg/MyCustomType")
    assert adapter is not None
    assert adapter.__name__ == "MyCustomAdapter"
    assert type(adapter.from_dict({})).__name__ == "MyCustomData"


def test_text_override_converts_its_topic_only(placeholders: Path, text: str) -> None:
    write_recording(placeholders / "sensor_data.mcap", StoragePlugin.MCAP)
    adapter = program_with(text, "class MyCustomLidarAdapter")
    run_module(placeholders, "my_adapter", adapter)
    # The program shows only the import that it adds; its ellipses stand for the others.
    names = {name: getattr(ros_bridge, name) for name in ("ROSInjectionConfig", "RosbagInjector")}
    run_module(placeholders, "main", program_with(text, "custom_lidar_run"), Path=Path, **names)
    stored_tags = tags("custom_lidar_run")
    assert (stored_tags["/lidar/front/pointcloud"], stored_tags["/lidar/rear/pointcloud"]) == (
        "MyLidar",
        "PointCloud2",
    )


def test_text_registered_types_are_used_without_custom_msgs(project: Path, text: str) -> None:
    write_recording(project / "mission_data.mcap", StoragePlugin.MCAP)
    (project / "setup_registry.py").write_text(program_with(text, "def initialize_project_schemas"))
    run_module(project, "main_injection", program_with(text, "import setup_registry"))
    assert {"common_msgs/msg/SystemHeartbeat", "robot_v3_msgs/msg/Arm"} == set(
        ROSTypeRegistry.get_types("ros2_humble")
    )
    assert {"/heartbeat", "/arm", "/gps/fix"} <= tags("mission_01").keys()


def commands(text: str) -> list[list[str]]:
    lines = re.sub(r"\\\n\s*", "", text).splitlines()
    actual = [shlex.split(line) for line in lines if line.startswith("mosaico_ingest.ros_injector")]
    return [["bag", *command[1:]] for command in actual]


def test_text_commands_run(project: Path, text: str) -> None:
    write_recording(project / "data.mcap", StoragePlugin.MCAP)
    write_recording(project / "data.db3", StoragePlugin.SQLITE3)
    (project / "metadata.json").write_text(json.dumps({"operator": "Alice"}))
    assert len(commands(text)) == 2
    for command in commands(text):
        with pytest.raises(SystemExit) as leave:
            main(command)
        assert not leave.value.code
        assert "Test_Run_01" in {sequence.name for sequence in Store.open(Path("mosaico")).sequences()}
        shutil.rmtree("mosaico")


def test_text_options_are_in_the_help(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["bag", "-h"])
    page = capsys.readouterr().out
    options = {word for command in commands(text) for word in command if word.startswith("--")}
    assert options
    assert all(option in page for option in options)


def table(text: str, title: str) -> list[str]:
    """Return the rows below a line that starts with `title`, up to an empty line."""
    lines = text.splitlines()
    start = next(at for at, line in enumerate(lines) if line.startswith(title)) + 1
    rows = lines[start:]
    return rows[: rows.index("") if "" in rows else None]


def types_of(row: str) -> list[str]:
    """Return the message types of a row; `Int8(16,32)` stands for Int8, Int16 and Int32."""
    match = _TYPE.match(row)
    assert match, row
    names: list[str] = []
    for name in re.findall(r"\w+(?:\([\d,]+\))?", match["names"]):
        stem, _, sizes = name.partition("(")
        names += [stem, *(re.sub(r"\d+$", "", stem) + size for size in sizes.rstrip(")").split(",") if sizes)]
    return [f"{match['package']}/msg/{name}" for name in names]


def test_text_type_table_adapters_produce_the_ontology_types(text: str) -> None:
    rows = table(text, "ROS Message Type Mosaico Ontology Type")
    assert len(rows) == 24
    for row in rows:
        for msgtype in types_of(row):
            adapter = ROSBridge.get_default_adapter(msgtype)
            assert adapter is not None, msgtype
            tag = adapter.ontology_data_type().ontology_tag()
            assert re.search(rf"\b{re.sub(r'(8|16|32|64)$', '', tag)}", row), (row, tag)
            if "_GenericStdAdapter" not in row:
                assert adapter.__name__ in row
    names = {name for row in rows for name in re.findall(r"\b[A-Z]\w+Adapter\b", row)}
    assert all(inspect.isclass(getattr(adapters, name)) for name in names)


def test_text_registry_table_methods_exist(text: str) -> None:
    rows = table(text, "Method Scope Description")
    methods = [row.partition("(")[0] for row in rows]
    assert len(methods) == 4
    assert all(callable(getattr(ROSTypeRegistry, method)) for method in methods)


def test_text_names_exist(text: str) -> None:
    pattern = (
        r"\b(?:ROS[A-Z]\w+|Rosbag\w+|Stores|\w+Adapter|\w+ErrorPolicy|\w+Enum|MosaicoClient|Serializable"
        r"|FrameTransform|BatteryState|PointCloud2|PointField|Transform|IMU|Image|register_\w+)\b"
    )
    names = set(re.findall(pattern, text)) - {"Serializable", "register_directory"}
    assert len(names) > 40
    for name in sorted(names - NOT_OURS.keys()):
        homes = (ros_bridge, adapters, models, mosaico_ingest)
        assert any(hasattr(home, name) for home in homes), name
    assert issubclass(ros_bridge.PointCloud2, Serializable)


def test_text_members_exist(text: str) -> None:
    policies = set(re.findall(r"\((IGNORE), (LOG_WARN), (RAISE)\)", text)[0])
    assert policies == set(ros_bridge.LoaderErrorPolicy.__members__)
    for name, member in re.findall(r"\b(\w+Policy|Stores|APIKeyPermissionEnum)\.(\w+)", text):
        assert hasattr(getattr(mosaico_ingest, name), member), (name, member)


def test_text_r2b_sequences_have_a_manifest(text: str, request: pytest.FixtureRequest) -> None:
    names = {row.split()[0] for row in table(text, "Sequence Name Compression Factor")}
    assert len(names) == 4
    folder = request.config.rootpath / "configs" / "r2b"
    assert {f"{name}.yaml" for name in names} <= {path.name for path in folder.glob("*.yaml")}
