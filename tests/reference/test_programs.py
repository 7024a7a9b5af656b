"""Programs and commands written for the SDK's bridge: they run if only their imports are changed."""

from __future__ import annotations

import json
from pathlib import Path
from textwrap import dedent

import pytest
from rosbags.rosbag2 import StoragePlugin
from sample_project import MESSAGES, run_program, write_recording

from mosaico_ingest.cli.app import main
from mosaico_ingest.destinations.store import Store


@pytest.mark.promise(
    "embedding",
    "config-arguments",
    "config-metadata",
    "config-topics",
    "config-override",
    "custom-msgs-names",
)
def test_injector_example_of_the_reference_stores_typed_topics(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_recording(project / "data" / "session_01.db3", StoragePlugin.SQLITE3)
    run_program(
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


@pytest.mark.promise("adapter-custom", "adapter-register")
def test_registered_adapter_converts_its_type(project: Path) -> None:
    write_recording(project / "run.mcap", StoragePlugin.MCAP)
    run_program(
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


@pytest.mark.promise("override-topic", "config-override")
def test_adapter_override_applies_to_its_topic_only(project: Path) -> None:
    write_recording(project / "sensor_data.mcap", StoragePlugin.MCAP)
    run_program(
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


@pytest.mark.promise("registry-preload")
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
    run_program(
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
@pytest.mark.promise("cli-basic", "cli-options")
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


@pytest.mark.promise("cli-help")
def test_bag_command_short_help_option_lists_the_options(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as leave:
        main(["bag", "-h"])
    assert not leave.value.code
    assert "--ros-distro" in capsys.readouterr().out
