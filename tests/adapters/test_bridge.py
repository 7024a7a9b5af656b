"""The precedence of adapters for a topic, and the stated reason of each choice."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from mosaico_ingest.adapters import bridge as bridge_module
from mosaico_ingest.adapters import python as base
from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.bridge import ROSBridge
from mosaico_ingest.adapters.builtin import BY_NAME
from mosaico_ingest.adapters.python import PythonAdapterSpec, ROSAdapterBase, register_default_adapter
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.ontology.model import Serializable
from mosaico_ingest.ontology.registry import SerializationFormat
from mosaico_ingest.rosbag.blocks import ROSMessage
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition

IMU, CLOUD = "sensor_msgs/msg/Imu", "sensor_msgs/msg/PointCloud2"

TEN_LINES = """
version: 1
adapter: TicksAdapter
ros_type: std_msgs/msg/Int32
ontology: {tag: BridgeTicks, fields: {ticks: {type: int32, unit: tick, nullable: false}}}
fields: {ticks: data}
tests:
  - name: nominal
    given: {data: 3}
    expect: {ticks: 3}
"""


class BridgeRow(Serializable):
    """The ontology class of the tests."""

    x: float


class MyImuAdapter(ROSAdapterBase[BridgeRow]):
    ros_msgtype = IMU
    __mosaico_ontology_type__ = BridgeRow

    @classmethod
    def from_dict(cls, ros_data: dict[str, Any], **_: Any) -> BridgeRow:
        return BridgeRow(x=ros_data["linear_acceleration"]["x"])


@pytest.fixture(autouse=True)
def _nothing_stays_registered() -> Iterator[None]:
    before = dict(base._registered)
    yield
    base._registered.clear()
    base._registered.update(before)
    bridge_module._entry_point_adapters.cache_clear()


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Pretend that a package offers an adapter as an entry point."""

    def offer(value: str) -> None:
        entry = EntryPoint("mine", value, bridge_module.ENTRY_POINTS)
        monkeypatch.setattr(bridge_module, "entry_points", lambda group: [entry] if group else [])
        bridge_module._entry_point_adapters.cache_clear()

    return offer


def test_resolve_without_other_source_uses_builtin(tmp_path: Path) -> None:
    choice = ROSBridge(base_dir=tmp_path).resolve("/imu", "sensor_msgs/Imu")
    assert (choice.spec.name, choice.reason, choice.unmodeled) == ("IMUAdapter", "built-in", False)


@pytest.mark.promise("no-adapter")
def test_resolve_unknown_type_is_unmodeled() -> None:
    bridge = ROSBridge(formats={"visualization_msgs/Marker": "ragged"})
    choice = bridge.resolve("/m", "visualization_msgs/msg/Marker")
    assert (choice.spec.name, choice.reason, choice.unmodeled) == ("Unmodeled", "unmodeled", True)
    assert choice.spec.serialization_format is SerializationFormat.RAGGED
    with pytest.raises(AdapterError, match="no serialization format 'raged'"):
        ROSBridge(formats={"visualization_msgs/Marker": "raged"})
    assert choice.why == "no adapter takes visualization_msgs/msg/Marker; its messages keep their shape"


def test_resolve_sources_follow_precedence(tmp_path: Path, installed: Callable[[str], None]) -> None:
    (tmp_path / "imu.yaml").write_text(
        BY_NAME["IMUAdapter"].path.read_text().replace("IMUAdapter", "LoadedAdapter")
    )
    installed(f"{__name__}:MyImuAdapter")
    sys.modules.setdefault(__name__, sys.modules[MyImuAdapter.__module__])
    choice = ROSBridge().resolve("/imu", IMU)
    assert (choice.spec.name, choice.reason) == ("MyImuAdapter", "entry point")

    @register_default_adapter
    class RegisteredAdapter(MyImuAdapter): ...

    assert ROSBridge().resolve("/imu", IMU).reason == "registered"
    loaded = ROSBridge(loaded=["imu.yaml"], base_dir=tmp_path)
    assert loaded.resolve("/imu", IMU).why == "loaded from imu.yaml"
    assert loaded.resolve("/imu", IMU).spec.name == "LoadedAdapter"
    both = ROSBridge(loaded=["imu.yaml"], overrides={"/i*": RegisteredAdapter}, base_dir=tmp_path)
    choice = both.resolve("/imu", IMU)
    assert (choice.spec.name, choice.reason, choice.why) == (
        "RegisteredAdapter",
        "override",
        "override '/i*'",
    )
    assert both.resolve("/other", IMU).reason == "loaded"


def test_resolve_exact_override_precedes_glob() -> None:
    bridge = ROSBridge(overrides={"/lidar/*": "LidarAdapter", "/lidar/radar": "RadarAdapter"})
    assert bridge.resolve("/lidar/top", CLOUD).spec.name == "LidarAdapter"
    assert bridge.resolve("/lidar/radar", CLOUD).spec.name == "RadarAdapter"
    assert bridge.resolve("/camera", CLOUD).spec.name == "PointCloudAdapter"


@pytest.mark.parametrize("form", ["class", "spec", "name", "module", "file", "yaml", "catalog class"])
def test_resolve_override_accepts_every_reference_form(form: str, tmp_path: Path) -> None:
    source = Path(__file__).read_text().replace("BridgeRow", "BridgeFileRow")
    (tmp_path / "a_file_of_adapters.py").write_text(source)
    (tmp_path / "imu.yaml").write_text(BY_NAME["IMUAdapter"].path.read_text())
    reference: Any = {
        "class": MyImuAdapter,
        "spec": PythonAdapterSpec(MyImuAdapter),
        "name": "IMUAdapter",
        "module": "mosaico_ingest.adapters:IMUAdapter",
        "file": "a_file_of_adapters.py:MyImuAdapter",
        "yaml": "imu.yaml",
        "catalog class": BY_NAME["IMUAdapter"],
    }[form]
    choice = ROSBridge(overrides={"/imu": reference}, base_dir=tmp_path).resolve("/imu", IMU)
    assert choice.reason == "override"
    assert choice.spec.name in {"MyImuAdapter", "IMUAdapter"}


def test_resolve_override_of_other_type_raises_with_both_types() -> None:
    bridge = ROSBridge(overrides={"/lidar/*": "LidarAdapter"})
    with pytest.raises(AdapterError) as caught:
        bridge.resolve("/lidar/imu", IMU)
    assert caught.value.where == "/lidar/imu"
    for value in ("/lidar/*", "LidarAdapter", "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Imu"):
        assert value in caught.value.what


def test_resolve_override_unmodeled_keeps_ros_shape() -> None:
    choice = ROSBridge(overrides={"/imu": "Unmodeled"}).resolve("/imu", IMU)
    assert (choice.spec.name, choice.reason) == ("Unmodeled", "override")


def test_resolve_override_finds_loaded_adapter_by_name(tmp_path: Path) -> None:
    (tmp_path / "ticks.yaml").write_text(TEN_LINES.replace("ontology:", "default: false\nontology:"))
    bridge = ROSBridge(loaded=["ticks.yaml"], overrides={"/ticks": "TicksAdapter"}, base_dir=tmp_path)
    assert bridge.resolve("/ticks", "std_msgs/msg/Int32").spec.name == "TicksAdapter"
    assert bridge.resolve("/count", "std_msgs/msg/Int32").spec.name == "Integer32StdAdapter"


def test_bridge_two_loaded_adapters_for_one_type_raise(tmp_path: Path) -> None:
    (tmp_path / "one.yaml").write_text(TEN_LINES)
    (tmp_path / "two.yaml").write_text(TEN_LINES.replace("TicksAdapter", "OtherAdapter"))
    with pytest.raises(
        AdapterError,
        match=r"TicksAdapter \(loaded from one.yaml\) and OtherAdapter .* both take std_msgs/msg/Int32",
    ):
        ROSBridge(loaded=["one.yaml", "two.yaml"], base_dir=tmp_path)


def test_bridge_broken_entry_point_raises_with_its_name(installed: Callable[[str], None]) -> None:
    installed("no_such_module_anywhere:Adapter")
    with pytest.raises(
        AdapterError, match="entry point mine of an installed package cannot be used: ModuleNotFoundError"
    ):
        ROSBridge().resolve("/imu", IMU)


def test_mapping_with_inline_ontology_adapts_rows(tmp_path: Path, define: Callable[..., Definition]) -> None:
    (tmp_path / "ticks.yaml").write_text(TEN_LINES)
    choice = ROSBridge(loaded=["ticks.yaml"], base_dir=tmp_path).resolve("/ticks", "std_msgs/Int32")
    definition = define("std_msgs/msg/Int32")
    bound = choice.spec.bind(definition, ros_shape(definition))
    rows = pa.array([{"data": 3}], ros_shape(definition))
    adapted = bound.adapt(rows, Envelope("/ticks", definition.root, np.zeros(1, np.int64)))
    assert (bound.ontology.tag, adapted.rows.to_pylist()) == ("BridgeTicks", [{"ticks": 3}])


def test_mapping_uses_adapter_of_same_folder(tmp_path: Path, define: Callable[..., Definition]) -> None:
    (tmp_path / "points.yaml").write_text(
        "version: 1\nadapter: FlatPointAdapter  # without height\nros_type: geometry_msgs/msg/Point32\n"
        "ontology: Point3d\nfields: {x: x, y: y, z: 0.0}\n"
    )
    (tmp_path / "older.yaml").mkdir()  # passed over, as whatever else cannot be read
    (tmp_path / "outline.yaml").write_text(
        "version: 1\nadapter: OutlineAdapter\nros_type: geometry_msgs/msg/Polygon\nontology: Polygon\n"
        "fields: {points: {use: FlatPointAdapter, of: 'points[]'}}\n"
    )
    choice = ROSBridge(loaded=["outline.yaml"], base_dir=tmp_path).resolve("/p", "geometry_msgs/msg/Polygon")
    spec = pickle.loads(pickle.dumps(choice.spec))  # noqa: S301 - pickled in this line
    definition = define("geometry_msgs/msg/Polygon")
    rows = pa.array([{"points": [{"x": 1.0, "y": 2.0, "z": 3.0}]}], ros_shape(definition))
    adapted = spec.bind(definition, rows.type).adapt(
        rows, Envelope("/p", definition.root, np.zeros(1, np.int64))
    )
    assert [(p["x"], p["z"]) for p in adapted.rows[0]["points"].as_py()] == [(1.0, 0.0)]


def test_module_reference_restores_sys_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "ticks.py").write_text(
        "from mosaico_ingest import ROSAdapterBase\nclass Ticks(ROSAdapterBase):\n    ros_msgtype = 'a/msg/B'\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    before = list(sys.path)
    ROSBridge(loaded=["ticks.py:Ticks"], base_dir=tmp_path)
    assert sys.path == before


def test_resolve_image_setting_wraps_selected_adapter(define: Callable[..., Definition]) -> None:
    bridge = ROSBridge(images={"/cam/*": "png", "/cam/raw": "raw"})
    definition = define("sensor_msgs/msg/Image")
    message = {"height": 1, "width": 1, "step": 1, "encoding": "mono8", "data": b"x"}
    rows = pa.array([message], ros_shape(definition))
    envelope = Envelope("/cam", definition.root, np.zeros(1, np.int64))
    formats = {
        topic: bridge.resolve(topic, definition.root)
        .spec.bind(definition, rows.type)
        .adapt(rows, envelope)
        .rows[0]["format"]
        .as_py()
        for topic in ("/cam/left", "/cam/raw", "/other")
    }
    assert formats == {"/cam/left": "png", "/cam/raw": "raw", "/other": "raw"}


def test_bridge_for_config_applies_settings(tmp_path: Path) -> None:
    (tmp_path / "ticks.yaml").write_text(TEN_LINES)
    config = ROSInjectionConfig(
        file_path=tmp_path / "x.bag",
        sequence_name="s",
        adapter_override={"/imu": MyImuAdapter},
        manifest={"adapters": {"load": [tmp_path / "ticks.yaml"]}},
    )
    bridge = ROSBridge.for_job(config.job)
    assert bridge.resolve("/imu", IMU).reason == "override"
    assert bridge.resolve("/ticks", "std_msgs/msg/Int32").reason == "loaded"


def test_from_ros_message_translates_one_message() -> None:
    message = ROSBridge.from_ros_message(ROSMessage(5, "/s", "std_msgs/String", {"data": "hello"}))
    assert (message.timestamp_ns, message.ontology_tag(), message.data.data) == (5, "String", "hello")

    register_default_adapter(MyImuAdapter)
    imu = ROSMessage(6, "/imu", IMU, {"linear_acceleration": {"x": 4.0}})
    assert ROSBridge.from_ros_message(imu).data == BridgeRow(x=4.0)
    with pytest.raises(AdapterError, match="no adapter takes visualization_msgs/msg/Marker"):
        ROSBridge.from_ros_message(ROSMessage(0, "/m", "visualization_msgs/msg/Marker", {}))


@pytest.mark.promise("adapter-register")
def test_register_default_adapter_with_parentheses_registers_class() -> None:
    adapter = base.register_default_adapter()(MyImuAdapter)
    assert adapter is MyImuAdapter
    assert ROSBridge.get_default_adapter(IMU) is MyImuAdapter


def test_register_default_adapter_with_is_default_registers_class() -> None:
    base.register_default_adapter(is_default=True)(MyImuAdapter)
    assert ROSBridge.get_default_adapter("sensor_msgs/Imu") is MyImuAdapter


@pytest.mark.promise("bridge-registry")
def test_get_default_adapter_builtin_returns_its_class() -> None:
    adapter = ROSBridge.get_default_adapter(IMU)
    assert adapter is not None
    assert adapter.__name__ == "IMUAdapter"
    assert adapter.ontology_data_type().ontology_tag() == "IMU"


def test_get_default_adapter_unknown_type_returns_none() -> None:
    assert ROSBridge.get_default_adapter("own_msgs/msg/Unknown") is None
    assert not ROSBridge.is_msgtype_adapted("own_msgs/msg/Unknown")
    assert ROSBridge.is_msgtype_adapted(IMU)


def test_adapter_base_has_members_of_the_sdk() -> None:
    assert MyImuAdapter.ros_msg_type() == IMU
    assert MyImuAdapter.get_default_ros_msg() == IMU
    assert MyImuAdapter.is_rosmsg_type_valid("sensor_msgs/Imu")
    assert not MyImuAdapter.is_rosmsg_type_valid("sensor_msgs/msg/Image")
    assert MyImuAdapter.ontology_data_type() is BridgeRow


@pytest.mark.promise("adapter-abstract")
def test_adapter_base_is_abstract() -> None:
    with pytest.raises(TypeError):
        ROSAdapterBase()
