"""Programs written for the SDK's bridge: they run if only their imports are changed."""

from __future__ import annotations

import json
import runpy
import shutil
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from textwrap import dedent
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores as RosbagsStores
from rosbags.typesys import get_types_from_msg, get_typestore

from mosaico_ingest import ROSTypeRegistry
from mosaico_ingest.adapters import python as base
from mosaico_ingest.cli.app import main
from mosaico_ingest.destinations.store import Store

CUSTOM = {
    "my_custom_pkg/msg/Status": "std_msgs/Header header\nuint8 mode\nfloat32[] loads\n",
    "common_msgs/msg/SystemHeartbeat": "uint32 beat\n",
    "robot_v3_msgs/msg/Arm": "float64[6] joints\n",
}
HUMBLE = get_typestore(RosbagsStores.ROS2_HUMBLE)
for _name, _text in CUSTOM.items():
    HUMBLE.register(get_types_from_msg(_text, _name))
CLOUD = {
    "header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "depth"},
    "height": 1,
    "width": 2,
    "fields": [
        {"name": axis, "offset": 4 * at, "datatype": 7, "count": 1} for at, axis in enumerate(("x", "y", "z"))
    ],
    "point_step": 12,
    "row_step": 24,
    "data": np.arange(6, dtype="<f4").view(np.uint8),
    "is_dense": True,
}
IMAGE = {"height": 1, "width": 2, "encoding": "mono8", "step": 2, "data": np.array([7, 9], np.uint8)}
STATUS = {"mode": 3, "loads": np.array([0.5], np.float32)}
MESSAGES: Mapping[str, tuple[str, dict[str, Any]]] = {
    "/camera/depth/points": ("sensor_msgs/msg/PointCloud2", CLOUD),
    "/camera/front/image": ("sensor_msgs/msg/Image", IMAGE),
    "/camera/status": ("my_custom_pkg/msg/Status", STATUS),
    "/gps/fix": ("sensor_msgs/msg/NavSatFix", {"latitude": 45.0, "longitude": 9.0}),
    "/heartbeat": ("common_msgs/msg/SystemHeartbeat", {"beat": 5}),
    "/arm": ("robot_v3_msgs/msg/Arm", {"joints": np.arange(6.0)}),
    "/lidar/front/pointcloud": ("sensor_msgs/msg/PointCloud2", CLOUD),
    "/lidar/rear/pointcloud": ("sensor_msgs/msg/PointCloud2", CLOUD),
}
MY_ONTOLOGY = """
    from mosaico_ingest.models import Serializable


    class MyCustomData(Serializable):
        mode: int
        heaviest: float


    class MyLidar(Serializable):
        points: int
        frame: str
"""
MY_ADAPTER = """
    from typing import Any, Optional, Tuple, Type

    from mosaico_ingest.ros_bridge import ROSAdapterBase, ROSMessage
    from mosaico_ingest.models import Message
    from my_ontology import MyLidar


    class MyCustomLidarAdapter(ROSAdapterBase[MyLidar]):
        ros_msgtype: str | Tuple[str, ...] = "sensor_msgs/msg/PointCloud2"
        __mosaico_ontology_type__: Type[MyLidar] = MyLidar

        @classmethod
        def translate(cls, ros_msg: ROSMessage, **kwargs: Any) -> Message:
            return super().translate(ros_msg, **kwargs)

        @classmethod
        def from_dict(cls, ros_data: dict) -> MyLidar:
            return MyLidar(points=ros_data["width"] * ros_data["height"], frame=ros_data["header"]["frame_id"])

        @classmethod
        def schema_metadata(cls, ros_data: dict, **kwargs: Any) -> Optional[dict]:
            return None
"""


def message(msgtype: str, values: Mapping[str, Any]) -> Any:
    """Return a message; fields without a value are zero."""
    fields: dict[str, Any] = {}
    for name, (kind, detail) in HUMBLE.fielddefs[msgtype][1]:
        value = values.get(name)
        if kind.name == "NAME":
            fields[name] = message(str(detail), value or {})
        elif kind.name == "BASE":
            zero = {"string": "", "bool": False}.get(detail[0], 0)
            fields[name] = zero if value is None else value
        elif detail[0][0].name == "NAME":
            fields[name] = [message(str(detail[0][1]), one) for one in value or ()]
        else:
            fields[name] = np.zeros(detail[1], detail[0][1][0]) if value is None else value
    return HUMBLE.types[msgtype](**fields)


def write_recording(path: Path, plugin: StoragePlugin) -> Path:
    """Write three messages per topic; SQLite files contain no definitions, as those that Humble writes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = path.with_suffix("")
    with Writer(folder, version=8, storage_plugin=plugin) as writer:
        for topic, (msgtype, values) in MESSAGES.items():
            connection = writer.add_connection(topic, msgtype, typestore=HUMBLE)
            for at in range(3):
                writer.write(connection, 10**9 * at, HUMBLE.serialize_cdr(message(msgtype, values), msgtype))
    written = next(file for file in folder.iterdir() if file.suffix in {".db3", ".mcap"})
    shutil.move(written, path)
    shutil.rmtree(folder)
    if plugin is StoragePlugin.SQLITE3:
        with closing(sqlite3.connect(path)) as db:
            db.execute("DROP TABLE message_definitions")
            db.commit()
    return path


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A user's folder with modules, definitions and recordings; types and adapters that a program registers are removed at the end."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    Path("my_ontology.py").write_text(dedent(MY_ONTOLOGY))
    Path("my_adapter.py").write_text(dedent(MY_ADAPTER))
    definitions = tmp_path / "definitions"
    for path, name in (
        ("my_pkg/Status.msg", "my_custom_pkg/msg/Status"),
        ("Heartbeat.msg", "common_msgs/msg/SystemHeartbeat"),
        ("robot_v3/msgs/Arm.msg", "robot_v3_msgs/msg/Arm"),
    ):
        (definitions / path).parent.mkdir(parents=True, exist_ok=True)
        (definitions / path).write_text(CUSTOM[name])
    registered = dict(base._registered)
    yield tmp_path
    base._registered.clear()
    base._registered.update(registered)
    ROSTypeRegistry.reset()


def run(folder: Path, program: str) -> None:
    (folder / "program.py").write_text(dedent(program))
    runpy.run_path(str(folder / "program.py"), run_name="__main__")


def test_injector_example_of_the_reference_stores_typed_topics(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_recording(project / "data" / "session_01.db3", StoragePlugin.SQLITE3)
    run(
        project,
        """
        from pathlib import Path
        from mosaico_ingest import SessionLevelErrorPolicy, TopicLevelErrorPolicy
        from mosaico_ingest.ros_bridge import RosbagInjector, ROSInjectionConfig, Stores
        from mosaico_ingest.ros_bridge.adapters import RGBDCameraAdapter


        class MyCustomRGBDAdapter(RGBDCameraAdapter):
            pass


        def run_injection():
            config = ROSInjectionConfig(
                file_path=Path("data/session_01.db3"),
                sequence_name="test_ros_sequence",
                metadata={"driver_version": "v2.1", "weather": "sunny", "location": "test_track_A"},
                topics=["/cam*"],
                ros_distro=Stores.ROS2_HUMBLE,
                custom_msgs=[("my_custom_pkg", Path("./definitions/my_pkg/"), Stores.ROS2_HUMBLE)],
                adapter_override={"/camera/depth/points": MyCustomRGBDAdapter},
                log_level="WARNING",
                on_error=SessionLevelErrorPolicy.Report,
                topics_on_error=TopicLevelErrorPolicy.Raise,
            )
            ingestor = RosbagInjector(config)
            try:
                ingestor.run()
                print("Injection job completed successfully.")
            except Exception as e:
                print(f"Injection job failed: {e}")


        if __name__ == "__main__":
            run_injection()
        """,
    )
    assert capsys.readouterr().out == "Injection job completed successfully.\n"
    sequence = Store.open(Path("mosaico")).sequence("test_ros_sequence")
    assert sequence.metadata["weather"] == "sunny"
    tags = {topic.name: topic.ontology.tag for topic in sequence.topics}
    assert tags == {
        "/camera/depth/points": "RGBDCamera",
        "/camera/front/image": "Image",
        "/camera/status": "Status",
    }


def test_registered_adapter_converts_its_type(project: Path) -> None:
    write_recording(project / "run.mcap", StoragePlugin.MCAP)
    run(
        project,
        """
        from pathlib import Path
        from mosaico_ingest.ros_bridge import ROSAdapterBase, ROSInjectionConfig, ROSMessage, RosbagInjector, register_default_adapter
        from mosaico_ingest.models import Message
        from my_ontology import MyCustomData


        @register_default_adapter
        class MyCustomAdapter(ROSAdapterBase[MyCustomData]):
            ros_msgtype = "my_custom_pkg/msg/Status"
            __mosaico_ontology_type__ = MyCustomData

            @classmethod
            def from_dict(cls, ros_data: dict, **kwargs) -> MyCustomData:
                return MyCustomData(mode=ros_data["mode"], heaviest=max(ros_data["loads"]))


        RosbagInjector(ROSInjectionConfig(file_path=Path("run.mcap"), sequence_name="registered")).run()
        """,
    )
    rows = Store.open(Path("mosaico")).scan("registered", "/camera/status")
    assert rows.read_all().column("heaviest").to_pylist() == [0.5, 0.5, 0.5]


def test_adapter_override_applies_to_its_topic_only(project: Path) -> None:
    write_recording(project / "sensor_data.mcap", StoragePlugin.MCAP)
    run(
        project,
        """
        from pathlib import Path
        from mosaico_ingest.ros_bridge import RosbagInjector, ROSInjectionConfig
        from my_adapter import MyCustomLidarAdapter

        config = ROSInjectionConfig(
            file_path=Path("sensor_data.mcap"),
            sequence_name="custom_lidar_run",
            adapter_override={
                "/lidar/front/pointcloud": MyCustomLidarAdapter,
            },
        )

        ingestor = RosbagInjector(config)
        ingestor.run()
        """,
    )
    sequence = Store.open(Path("mosaico")).sequence("custom_lidar_run")
    tags = {topic.name: topic.ontology.tag for topic in sequence.topics}
    assert tags["/lidar/front/pointcloud"] == "MyLidar"
    assert tags["/lidar/rear/pointcloud"] == "PointCloud2"


def test_registered_types_are_used_by_later_runs(project: Path) -> None:
    Path("setup_registry.py").write_text(
        dedent(
            """
            from pathlib import Path
            from mosaico_ingest.ros_bridge import ROSTypeRegistry, Stores

            def initialize_project_schemas():
                ROSTypeRegistry.register(
                    msg_type="common_msgs/msg/SystemHeartbeat",
                    source=Path("./definitions/Heartbeat.msg")
                )
                ROSTypeRegistry.register_directory(
                    package_name="robot_v3_msgs",
                    dir_path=Path("./definitions/robot_v3/msgs"),
                    store=Stores.ROS2_HUMBLE
                )
            """
        )
    )
    write_recording(project / "mission_data.db3", StoragePlugin.SQLITE3)
    run(
        project,
        """
        import setup_registry
        from mosaico_ingest.ros_bridge import RosbagInjector, ROSInjectionConfig, Stores
        from pathlib import Path

        setup_registry.initialize_project_schemas()

        config = ROSInjectionConfig(
            file_path=Path("mission_data.db3"),
            sequence_name="mission_01",
            metadata={"operator": "Alice"},
            ros_distro=Stores.ROS2_HUMBLE,
        )

        ingestor = RosbagInjector(config)
        ingestor.run()
        """,
    )
    names = {topic.name for topic in Store.open(Path("mosaico")).sequence("mission_01").topics}
    assert {"/heartbeat", "/arm", "/gps/fix"} <= names
    assert "/camera/status" not in names  # its type is not registered


@pytest.mark.parametrize(
    ("arguments", "topics"),
    [
        (("./data.mcap", "--name", "Test_Run_01"), len(MESSAGES)),
        (
            (
                "./data.db3", "--name", "Test_Run_01", "--topics", "/camera/front/*", "/gps/fix",
                "--metadata", "./metadata.json", "--ros-distro", "ros2_humble",
            ),
            2,
        ),
    ],
    ids=["basic", "all options"],
)  # fmt: skip
def test_bag_command_accepts_the_options_of_the_reference(
    project: Path, arguments: tuple[str, ...], topics: int
) -> None:
    plugin = StoragePlugin.MCAP if arguments[0].endswith("mcap") else StoragePlugin.SQLITE3
    write_recording(project / arguments[0], plugin)
    (project / "metadata.json").write_text(json.dumps({"operator": "Alice"}))
    with pytest.raises(SystemExit) as leave:
        main(["bag", *arguments])
    assert not leave.value.code
    sequence = Store.open(Path("mosaico")).sequence("Test_Run_01")
    assert len(sequence.topics) == topics
    assert sequence.metadata.get("operator") == ("Alice" if "--metadata" in arguments else None)


def test_bag_command_short_help_option_lists_the_options(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as leave:
        main(["bag", "-h"])
    assert not leave.value.code
    assert "--ros-distro" in capsys.readouterr().out
