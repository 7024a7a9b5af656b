"""Adapters written for the official SDK: they run unchanged."""

from __future__ import annotations

import runpy
import sys
from contextlib import closing
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import rosbags.typesys

from mosaico_ingest.adapters.adapter import Adapted, Envelope
from mosaico_ingest.adapters.bridge import ROSBridge, load_adapter_reference
from mosaico_ingest.adapters.python import PythonAdapterSpec, ontology_of
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.encodings import MESSAGE_ENCODINGS, encoding_of
from mosaico_ingest.rosbag.rosbags_library import open_writer

pytestmark = pytest.mark.interop
sdk = pytest.importorskip("mosaicolabs.bridges.ros", reason="the official SDK is not installed")

WRITTEN_FOR_THE_SDK = """
from mosaicolabs import Message
from mosaicolabs.bridges.ros import ROSAdapterBase, ROSMessage
from mosaicolabs.models.data import Vector3d
from mosaicolabs.models.core import Serializable

class SdkSpeed(Serializable):
    value: float
    frame: str

class SpeedAdapter(ROSAdapterBase[SdkSpeed]):
    ros_msgtype = ("geometry_msgs/msg/TwistStamped",)
    __mosaico_ontology_type__ = SdkSpeed

    @classmethod
    def from_dict(cls, ros_data: dict) -> SdkSpeed:
        return SdkSpeed(value=1.0 / ros_data["twist"]["linear"]["x"], frame=ros_data["header"]["frame_id"])

class LateAdapter(SpeedAdapter):
    @classmethod
    def translate(cls, msg: ROSMessage, **kwargs) -> Message:
        message = super().translate(msg, **kwargs)
        stamp = msg.header.stamp
        return Message(timestamp_ns=stamp.seconds * 10**9 + stamp.nanoseconds, data=message.data)
"""


OURS_OVER_THEIR_ONTOLOGY = """
from mosaico_ingest import Message, ROSAdapterBase
from theirs import SdkSpeed

class OurSpeedAdapter(ROSAdapterBase[SdkSpeed]):
    ros_msgtype = "geometry_msgs/msg/TwistStamped"
    __mosaico_ontology_type__ = SdkSpeed

    @classmethod
    def from_dict(cls, ros_data):
        return SdkSpeed(value=ros_data["twist"]["linear"]["x"], frame=ros_data["header"]["frame_id"])

    @classmethod
    def translate(cls, ros_msg, **kwargs) -> Message:
        return super().translate(ros_msg, **kwargs)
"""


@pytest.fixture(scope="module")
def fuzz() -> Any:
    return runpy.run_path(str(Path(__file__).parents[1] / "adapters" / "fuzz.py"))["message"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One file for all tests: the SDK refuses a second model of the same name."""
    path = tmp_path_factory.mktemp("sdk")
    (path / "theirs.py").write_text(WRITTEN_FOR_THE_SDK)
    return path


def test_own_adapter_can_fill_an_ontology_class_of_the_sdk(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    theirs = load_adapter_reference("theirs.py:SpeedAdapter", folder)
    assert isinstance(theirs, PythonAdapterSpec)
    monkeypatch.setitem(sys.modules, "theirs", sys.modules[theirs.adapter.__module__])
    (folder / "ours.py").write_text(OURS_OVER_THEIR_ONTOLOGY)
    adapted = _adapt("ours.py:OurSpeedAdapter", folder, 2.0)
    assert adapted.rows.to_pylist() == [{"value": 2.0, "frame": "base"}]


def _adapt(ref: str, folder: Path, *speeds: float) -> Adapted:
    definition = TypeResolver(Stores.LATEST).resolve("geometry_msgs/msg/TwistStamped", None, ros_version=2)
    shape = ros_shape(definition)
    header = {"stamp": {"sec": 5, "nanosec": 6}, "frame_id": "base"}
    rows = pa.array([{"header": header, "twist": {"linear": {"x": x}}} for x in speeds], shape)
    envelope = Envelope("/speed", definition.root, np.arange(len(speeds), dtype=np.int64))
    return load_adapter_reference(ref, folder).bind(definition, shape).adapt(rows, envelope)


def test_sdk_adapter_from_dict_fills_the_sdk_model(folder: Path) -> None:
    adapted = _adapt("theirs.py:SpeedAdapter", folder, 2.0, 0.0, 4.0)
    assert adapted.rows.to_pylist() == [{"value": 0.5, "frame": "base"}, {"value": 0.25, "frame": "base"}]
    error, _, place = adapted.failures[0].reason.partition(" (")
    assert error == "SpeedAdapter: ZeroDivisionError: float division by zero"
    assert f"{folder / 'theirs.py'}:17, message 1, log time 1 ns; fields: header.stamp.sec" in place


def test_sdk_adapter_translate_receives_the_sdk_message(folder: Path) -> None:
    adapted = _adapt("theirs.py:LateAdapter", folder, 2.0)
    assert adapted.rows.field("value").to_pylist() == [0.5]
    assert adapted.log_times is not None
    assert adapted.log_times.tolist() == [5_000_000_006]


def test_override_can_name_a_builtin_adapter_of_the_sdk(folder: Path) -> None:
    bridge = ROSBridge(
        overrides={"/imu": "mosaicolabs.bridges.ros.adapters.sensor_msgs:IMUAdapter"}, base_dir=folder
    )
    choice = bridge.resolve("/imu", "sensor_msgs/msg/Imu")
    definition = TypeResolver(Stores.LATEST).resolve("sensor_msgs/msg/Imu", None, ros_version=2)
    bound: Any = choice.spec.bind(definition, ros_shape(definition))
    assert (bound.ontology.tag, bound.ontology.fingerprint) == ("IMU", "2d6a4121b0")


@pytest.mark.parametrize("msgtype", sorted(sdk.ROSBridge.get_default_adapters()))
def test_every_sdk_adapter_converts_our_rows(msgtype: str, fuzz: Any) -> None:
    adapter = sdk.ROSBridge.get_default_adapters()[msgtype]
    types = {"nmea_msgs/msg/Sentence": "std_msgs/Header header\nstring sentence\n"}
    definition = TypeResolver(Stores.LATEST, types=types).resolve(msgtype, None, ros_version=2)
    random = Random(msgtype)  # noqa: S311 - messages, not secrets
    messages = [_small(fuzz(definition, random)) for _ in range(30)]
    shape = ros_shape(definition)
    envelope = Envelope("/t", msgtype, np.arange(len(messages), dtype=np.int64))
    adapted = PythonAdapterSpec(adapter).bind(definition, shape).adapt(pa.array(messages, shape), envelope)
    assert adapted.index.tolist() == [row for row, message in enumerate(messages) if _taken(adapter, message)]


def _small(message: dict[str, Any]) -> dict[str, Any]:
    """Keep pictures of random sizes from being packed."""
    return {**message, "height": 1, "step": 0} if "encoding" in message else message


def _taken(adapter: Any, message: dict[str, Any]) -> bool:
    """Whether the SDK stores the message as its own loader hands it over: bytes as lists of numbers."""
    listed = {name: list(value) if isinstance(value, bytes) else value for name, value in message.items()}
    try:
        row = adapter.from_dict(listed).model_dump()
        pa.array([row], ontology_of(adapter.__mosaico_ontology_type__).struct)
    except Exception:  # noqa: BLE001 - whatever it raises is how it rejects a message
        return False
    return True


def test_migration_page_lists_every_setting_of_the_sdk() -> None:
    page = (Path(__file__).parents[2] / "docs" / "migration.md").read_text(encoding="utf-8")
    missing = {field.name for field in fields(sdk.ROSInjectionConfig) if f"`{field.name}`" not in page}
    assert missing == set()


@pytest.mark.parametrize("suffix", [".mcap", ".bag"])
def test_program_that_iterates_a_loader_sees_the_same_messages_with_both_packages(
    tmp_path: Path, suffix: str
) -> None:
    distro = Stores.ROS1_NOETIC if suffix == ".bag" else Stores.ROS2_HUMBLE
    definition = TypeResolver(distro).resolve(
        "geometry_msgs/msg/PointStamped", None, ros_version=1 if suffix == ".bag" else 2
    )
    header = {"seq": 1, "stamp": {"sec": 1, "nanosec": 2}, "frame_id": "map"}
    message = {"header": header, "point": {"x": 1.0, "y": 2.0, "z": 3.0}}
    payload = MESSAGE_ENCODINGS[encoding_of(definition)].writer(definition).from_dict(message)
    recording = tmp_path / f"r{suffix}"
    with open_writer(recording) as writer:
        connection = writer.add_connection("/point", definition)
        for log_ns, data in enumerate((payload, payload[:-8], payload), 1):
            writer.write(connection, log_ns, data)
    outcomes: list[list[Any]] = []
    for package in ("mosaicolabs", "mosaico_ingest"):
        module = import_module(f"{package}.bridges.ros")
        distros = rosbags.typesys.Stores
        with closing(module.ROSLoader(recording, distros(distro.value), ["/point"])) as loader:
            outcomes.append([_attributes(message, error) for message, error in loader])
    assert [outcome[-1] for outcome in outcomes[0]] == [True, False, True]
    assert outcomes[0] == outcomes[1]


def _attributes(message: Any, error: Exception | None) -> tuple[Any, ...]:
    stamp = message.header and (message.header.stamp.seconds, message.header.stamp.nanoseconds)
    constants = message.const_data or None
    names = (message.topic, message.bag_timestamp_ns, message.msg_type, message.data_field)
    return (*names, constants, stamp, error is None)
