"""A user's project: modules, message definitions and recordings for programs that use the SDK's names."""

from __future__ import annotations

import runpy
import shutil
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from textwrap import dedent
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mosaico_ingest import ROSTypeRegistry
from mosaico_ingest.adapters import python as base

CUSTOM = {
    "my_custom_pkg/msg/Status": "std_msgs/Header header\nuint8 mode\nfloat32[] loads\n",
    "common_msgs/msg/SystemHeartbeat": "uint32 beat\n",
    "robot_v3_msgs/msg/Arm": "float64[6] joints\n",
}
HUMBLE = get_typestore(Stores.ROS2_HUMBLE)
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
    """Write three messages per topic; SQLite files contain no definitions, like the files that Humble writes."""
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


def write_project(folder: Path) -> None:
    """Write the modules and definitions of the project."""
    (folder / "my_ontology.py").write_text(dedent(MY_ONTOLOGY))
    (folder / "my_adapter.py").write_text(dedent(MY_ADAPTER))
    for path, name in (
        ("my_pkg/Status.msg", "my_custom_pkg/msg/Status"),
        ("Heartbeat.msg", "common_msgs/msg/SystemHeartbeat"),
        ("robot_v3/msgs/Arm.msg", "robot_v3_msgs/msg/Arm"),
    ):
        file = folder / "definitions" / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(CUSTOM[name])


@contextmanager
def clean_registries() -> Iterator[None]:
    """Remove the types and adapters that a program registers."""
    registered = dict(base._registered)
    try:
        yield
    finally:
        base._registered.clear()
        base._registered.update(registered)
        ROSTypeRegistry.reset()


def run_program(folder: Path, program: str, **variables: Any) -> None:
    """Run a program as a script."""
    (folder / "program.py").write_text(dedent(program))
    runpy.run_path(str(folder / "program.py"), variables, run_name="__main__")
