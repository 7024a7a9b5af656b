"""The behavior that the reference describes in prose, from the loader to the registry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores as RosbagsStores
from rosbags.typesys import get_typestore
from sample_project import CUSTOM, MESSAGES, write_recording

from mosaico_ingest import (
    RosbagInjector,
    ROSBridge,
    ROSInjectionConfig,
    ROSLoader,
    ROSMessage,
    ROSTypeRegistry,
    Stores,
)
from mosaico_ingest.adapters import PoseAdapter
from mosaico_ingest.cli.app import main
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import BagError, IngestError
from mosaico_ingest.models.data import Pose
from mosaico_ingest.ontology import (
    BatteryState,
    FrameTransform,
    PointCloud2,
    PointField,
    Serializable,
    Transform,
)
from mosaico_ingest.ros_bridge import ROSAdapterBase
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.serve import serve

POSE = {"position": {"x": 1.0, "y": 2.0, "z": 3.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}


def topics_of(sequence: str, store: str = "mosaico") -> dict[str, tuple[str, int]]:
    topics = Store.open(Path(store)).sequence(sequence).topics
    return {topic.name: (topic.ontology.tag, topic.rows) for topic in topics}


@pytest.mark.promise("typed-objects")
def test_message_becomes_an_object_of_its_ontology_class() -> None:
    message = ROSBridge.from_ros_message(ROSMessage(5, "/pose", "geometry_msgs/msg/Pose", POSE))
    assert isinstance(message.data, Pose)
    assert message.data.position.z == 3.0


@pytest.mark.promise("unwrapping")
def test_nested_wrappers_are_unwrapped() -> None:
    stamp = {"sec": 7, "nanosec": 8}
    wrapped = {
        "header": {"stamp": stamp, "frame_id": "map"},
        "pose": {"pose": POSE, "covariance": [0.5] * 36},
    }
    pose = PoseAdapter.translate(
        ROSMessage(5, "/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", wrapped)
    ).data
    assert isinstance(pose, Pose)
    assert (pose.position.x, pose.header.frame_id if pose.header else "") == (1.0, "map")
    assert pose.covariance == [0.5] * 36


def write_ros1(path: Path) -> Path:
    typestore = get_typestore(RosbagsStores.ROS1_NOETIC)
    with Ros1Writer(path) as writer:
        connection = writer.add_connection("/text", "std_msgs/msg/String", typestore=typestore)
        text = typestore.types["std_msgs/msg/String"](data="hello")
        writer.write(connection, 5, typestore.serialize_ros1(text, "std_msgs/msg/String"))
    return path


@pytest.mark.promise("loader-containers")
@pytest.mark.parametrize("suffix", [".bag", ".db3", ".mcap"])
def test_loader_reads_every_container(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"drive{suffix}"
    if suffix == ".bag":
        expected = {"/text"}
        write_ros1(path)
    else:
        plugin = StoragePlugin.MCAP if suffix == ".mcap" else StoragePlugin.SQLITE3
        write_recording(path, plugin)
        expected = set(MESSAGES)
    with ROSLoader(path, Stores.ROS2_HUMBLE, custom_types=CUSTOM, error_policy="raise") as loader:
        assert {message.topic for message, _ in loader} == expected


@pytest.mark.promise("loader-globs")
def test_loader_selects_topics_by_glob(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "drive.mcap", StoragePlugin.MCAP)
    with ROSLoader(path, topics=["/cam*", "/gps/fix", "!/camera/status"]) as loader:
        assert loader.topics == ["/camera/depth/points", "/camera/front/image", "/gps/fix"]


@pytest.mark.promise("server-session", "server-sequence", "server-stream", "server-commit", "custom-msgs-run")
def test_injector_uploads_a_recording_with_custom_types_to_a_server(project: Path) -> None:
    path = write_recording(project / "drive.db3", StoragePlugin.SQLITE3)
    with serve(project / "served", port=0) as server:
        config = ROSInjectionConfig(
            file_path=path,
            sequence_name="uploaded",
            metadata={"driver": "Alice"},
            topics=["/camera/*"],
            ros_distro=Stores.ROS2_HUMBLE,
            custom_msgs=[("my_custom_pkg", project / "definitions/my_pkg", Stores.ROS2_HUMBLE)],
            host="localhost",
            port=server.port,
        )
        report = RosbagInjector(config).run()
    assert report.totals.written == 9
    assert Store.open(project / "served").sequence("uploaded").metadata["driver"] == "Alice"
    assert topics_of("uploaded", "served") == {
        "/camera/depth/points": ("PointCloud2", 3),
        "/camera/front/image": ("Image", 3),
        "/camera/status": ("Status", 3),
    }
    assert ROSTypeRegistry.get_types() == {}  # `custom_msgs` belong to one run


@pytest.mark.promise("config-shared")
def test_program_and_command_store_the_same_content(project: Path) -> None:
    path = write_recording(project / "drive.mcap", StoragePlugin.MCAP)
    RosbagInjector(ROSInjectionConfig(path, "program", topics=["/cam*"])).run()
    with pytest.raises(SystemExit) as leave:
        main(["bag", str(path), "--name", "command", "--topics", "/cam*"])
    assert not leave.value.code
    assert topics_of("program") == topics_of("command")
    store = Store.open(Path("mosaico"))
    for topic in topics_of("program"):
        one, other = (store.scan(name, topic).read_all() for name in ("program", "command"))
        assert one.equals(other)


@pytest.mark.promise("config-file-path", "run-raises")
def test_run_of_a_missing_file_raises(project: Path) -> None:
    with pytest.raises(BagError, match=r"missing\.db3"):
        RosbagInjector(ROSInjectionConfig(project / "missing.db3", "missing")).run()


@pytest.mark.promise("topics-on-error-raise", "on-error-report")
def test_topic_error_with_policy_raise_ends_the_run_and_keeps_the_report(project: Path) -> None:
    path = write_recording(project / "drive.mcap", StoragePlugin.MCAP)

    class Refuses(ROSAdapterBase[Pose]):
        ros_msgtype = "sensor_msgs/msg/NavSatFix"
        __mosaico_ontology_type__ = Pose

        @classmethod
        def from_dict(cls, ros_data: dict[str, Any]) -> Pose:
            raise ValueError(f"refused {len(ros_data)} fields")

    config = ROSInjectionConfig(
        path, "ended", adapter_override={"/gps/fix": Refuses}, on_error="report", topics_on_error="raise"
    )
    with pytest.raises(IngestError, match="/gps/fix"):
        RosbagInjector(config).run()
    (sequence,) = Store.open(Path("mosaico")).sequences()
    assert sequence.name == "ended"


@pytest.mark.promise("db3-needs-distro")
def test_sqlite_recording_uses_the_definitions_of_the_distro(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "drive.db3", StoragePlugin.SQLITE3)
    with ROSLoader(path, Stores.ROS2_HUMBLE, error_policy="ignore") as loader:
        assert "/gps/fix" in loader.resolved_topics
        assert "/camera/status" not in loader.resolved_topics


@pytest.mark.promise("adapter-types")
def test_adapter_declares_one_type_or_several() -> None:
    assert PoseAdapter.is_rosmsg_type_valid("geometry_msgs/msg/PoseStamped")

    class One(PoseAdapter):
        ros_msgtype = "geometry_msgs/msg/Pose"

    assert not One.is_rosmsg_type_valid("geometry_msgs/msg/PoseStamped")


@pytest.mark.promise("adapter-schema-metadata")
def test_schema_metadata_is_stored_with_the_topic(project: Path) -> None:
    path = write_recording(project / "drive.mcap", StoragePlugin.MCAP)

    class Fix(ROSAdapterBase[Pose]):
        ros_msgtype = "sensor_msgs/msg/NavSatFix"
        __mosaico_ontology_type__ = Pose

        @classmethod
        def from_dict(cls, ros_data: dict[str, Any]) -> Pose:
            position = {"x": ros_data["longitude"], "y": ros_data["latitude"], "z": 0.0}
            return Pose.model_validate({**POSE, "position": position})

        @classmethod
        def schema_metadata(cls, ros_data: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
            return {"first_latitude": ros_data["latitude"], **kwargs}

    config = ROSInjectionConfig(path, "drive", topics="/gps/fix", adapter_override={"/gps/fix": Fix})
    RosbagInjector(config).run()
    (topic,) = Store.open(Path("mosaico")).sequence("drive").topics
    assert topic.metadata["first_latitude"] == 45.0


@pytest.mark.promise("registry-isolation")
def test_header_differs_between_distros() -> None:
    fields = {
        distro: [
            field.name
            for field in TypeResolver(distro)
            .resolve("std_msgs/msg/Header", None, ros_version=version)
            .message.fields
        ]
        for distro, version in (("ros1_noetic", 1), ("ros2_humble", 2))
    }
    assert fields == {"ros1_noetic": ["seq", "stamp", "frame_id"], "ros2_humble": ["stamp", "frame_id"]}


@pytest.mark.promise("registry-shared", "registry-loader", "registry-scopes", "registry-reset")
def test_loader_uses_registered_types_of_its_distro(project: Path) -> None:
    path = write_recording(project / "drive.db3", StoragePlugin.SQLITE3)
    ROSTypeRegistry.register("common_msgs/msg/SystemHeartbeat", project / "definitions/Heartbeat.msg")
    ROSTypeRegistry.register_directory(
        "robot_v3_msgs", project / "definitions/robot_v3/msgs", Stores.ROS2_JAZZY
    )
    with ROSLoader(path, Stores.ROS2_HUMBLE, error_policy="ignore") as loader:
        assert "/heartbeat" in loader.resolved_topics
        assert "/arm" not in loader.resolved_topics
    ROSTypeRegistry.reset()
    with ROSLoader(path, Stores.ROS2_HUMBLE, error_policy="ignore") as loader:
        assert "/heartbeat" not in loader.resolved_topics


@pytest.mark.promise(
    "model-frame-transform", "model-battery-state", "model-point-cloud", "models-serializable"
)
def test_ros_specific_models_have_their_fields() -> None:
    assert all(issubclass(model, Serializable) for model in (FrameTransform, BatteryState, PointCloud2))
    transforms = FrameTransform.model_fields["transforms"].annotation
    assert transforms == list[Transform]
    assert {"voltage", "current", "capacity", "percentage"} <= BatteryState.model_fields.keys()
    assert {"power_supply_health", "power_supply_technology", "power_supply_status", "cell_voltage"} <= (
        BatteryState.model_fields.keys()
    )
    assert {"height", "width", "fields", "is_bigendian", "data"} <= PointCloud2.model_fields.keys()
    assert {"name", "offset", "datatype", "count"} == PointField.model_fields.keys()


def test_custom_msgs_of_a_run_take_precedence_and_affect_no_other_run(project: Path) -> None:
    path = write_recording(project / "drive.db3", StoragePlugin.SQLITE3)
    other = project / "other" / "SystemHeartbeat.msg"
    other.parent.mkdir()
    other.write_text("uint16 low\nuint16 high\n")
    ROSTypeRegistry.register("common_msgs/msg/SystemHeartbeat", project / "definitions/Heartbeat.msg")
    columns: dict[str, list[str]] = {}
    for name, custom in (("own", [("common_msgs", other.parent, None)]), ("shared", None)):
        config = ROSInjectionConfig(
            path, name, topics="/heartbeat", ros_distro="ros2_humble", custom_msgs=custom
        )
        RosbagInjector(config).run()
        rows = Store.open(Path("mosaico")).scan(name, "/heartbeat").read_all()
        columns[name] = rows.column_names[1:]
    assert columns == {"own": ["low", "high"], "shared": ["beat"]}
