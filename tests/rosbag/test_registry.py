"""Types that a program registers for all recordings."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from mosaico_ingest.errors import BagError
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.definitions.model import Source
from mosaico_ingest.rosbag.definitions.registry import ROSTypeRegistry, TypeResolver


@pytest.fixture(autouse=True)
def _forget() -> Iterator[None]:
    ROSTypeRegistry.reset()
    yield
    ROSTypeRegistry.reset()


@pytest.mark.promise("registry-register")
def test_register_accepts_text_and_path(tmp_path: Path) -> None:
    file = tmp_path / "my messages" / "Heartbeat.msg"
    file.parent.mkdir()
    file.write_text("int8 from_file\n")
    ROSTypeRegistry.register("a/msg/Text", "int8 from_text")
    ROSTypeRegistry.register("a/Path", file)
    ROSTypeRegistry.register("a/msg/Name", str(file))
    assert ROSTypeRegistry.get_types() == {
        "a/msg/Text": "int8 from_text",
        "a/msg/Path": "int8 from_file\n",
        "a/msg/Name": "int8 from_file\n",
    }


@pytest.mark.promise("registry-cascade")
def test_registry_distro_overlays_types_of_all_distros() -> None:
    ROSTypeRegistry.register("a/msg/B", "int8 for_all")
    ROSTypeRegistry.register("a/msg/B", "int8 for_humble", store="ros2_humble")
    assert ROSTypeRegistry.get_types(Stores.ROS2_HUMBLE) == {"a/msg/B": "int8 for_humble"}
    assert ROSTypeRegistry.get_types("ros2_jazzy") == {"a/msg/B": "int8 for_all"}
    assert ROSTypeRegistry.get_types() == {"a/msg/B": "int8 for_all"}


def test_registered_types_yield_to_types_of_job() -> None:
    ROSTypeRegistry.register("a/msg/B", "int8 announced")
    definition = TypeResolver().resolve("a/msg/B", None, ros_version=2)
    assert (definition.message.fields[0].name, definition.source) == ("announced", Source.CUSTOM)
    own = TypeResolver(types={"a/msg/B": "int8 own"}).resolve("a/msg/B", None, ros_version=2)
    assert own.message.fields[0].name == "own"


@pytest.mark.promise("registry-directory")
def test_register_directory_registers_every_file(tmp_path: Path) -> None:
    (tmp_path / "One.msg").write_text("Two two\n")
    (tmp_path / "Two.msg").write_text("int8 x\n")
    (tmp_path / "README").write_text("not a message")
    ROSTypeRegistry.register_directory("pkg", tmp_path, store=Stores.ROS2_HUMBLE)
    assert sorted(ROSTypeRegistry.get_types("ros2_humble")) == ["pkg/msg/One", "pkg/msg/Two"]
    definition = TypeResolver("ros2_humble").resolve("pkg/msg/One", None, ros_version=2)
    assert definition.message.fields[0].type == "pkg/msg/Two"


def test_register_invalid_file_raises_with_line_and_registers_nothing(tmp_path: Path) -> None:
    (tmp_path / "Bad.msg").write_text("int8 good\nfloat64[ bad\n")
    (tmp_path / "Good.msg").write_text("int8 good\n")
    with pytest.raises(BagError, match=r"Bad\.msg:2:1: cannot parse 'float64\[ bad'"):
        ROSTypeRegistry.register_directory("pkg", tmp_path)
    assert ROSTypeRegistry.get_types() == {}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("pkg/msg/X", "missing.msg"), "cannot read the definition: No such file"),
        (("pkg/msg/X", Path("missing.msg")), "cannot read the definition: No such file"),
        (("X", "int8 x"), "write it as pkg/msg/Name"),
        (("pkg/msg/X", "int8 x", "ros2_humbel"), r"did you mean ros2_humble\?"),
    ],
)
def test_register_invalid_source_raises(arguments: tuple[str, ...], message: str) -> None:
    with pytest.raises(BagError, match=message):
        ROSTypeRegistry.register(*arguments)


def test_register_missing_directory_raises(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="does not exist"):
        ROSTypeRegistry.register_directory("pkg", tmp_path / "nowhere")
