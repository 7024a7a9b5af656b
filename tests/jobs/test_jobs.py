"""Cases of complete jobs, one per folder, each run with every container.

`job.yaml` is the manifest. `messages.yaml` lists the messages of the recording as `{t: seconds, topic, type, data}`; missing
fields of `data` are zero, and `raw: "hex"` is a payload in bytes. `expected.yaml` contains the exit code, a part of the error,
and counts and rows per topic; a row contains only the fields to compare. `containers` limits the containers.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import yaml
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from mosaico_ingest import api
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import IngestError
from mosaico_ingest.report.recording import Report, TopicReport
from mosaico_ingest.rosbag.blocks import Encoding
from mosaico_ingest.rosbag.definitions.model import Container, Definition, Field
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.serialization import Serializer

CASES = sorted(path.parent for path in Path(__file__).parent.glob("*/job.yaml"))
CONTAINERS = {"recording.mcap": 2, "recording.db3": 2, "recording.bag": 1}
START_S = 1_700_000_000


def default(field: Field, definition: Definition, value: Any) -> Any:
    """Return a value with all fields of nested messages; missing values are zero."""
    if field.container is Container.SCALAR:
        if field.is_message:
            return complete(field.type, definition, value or {})
        zero: Any = "" if "string" in field.type else False if field.type == "bool" else 0
        return zero if value is None else value
    count = field.size if field.container is Container.ARRAY else 0
    elements = [None] * count if value is None else value
    if isinstance(elements, str):
        return bytes.fromhex(elements)
    one = Field(field.name, field.type, field.is_message)
    filled = [default(one, definition, element) for element in elements]
    return bytes(filled) if field.type in {"uint8", "byte", "char"} and not count else filled


def complete(msgtype: str, definition: Definition, values: dict[str, Any]) -> dict[str, Any]:
    if msgtype in {"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration", "time", "duration"}:
        return {"sec": 0, "nanosec": 0, **values}
    fields = definition.types[msgtype].fields
    assert not values.keys() - {field.name for field in fields}, f"{msgtype} has no such field"
    return {field.name: default(field, definition, values.get(field.name)) for field in fields}


def write_recording(path: Path, messages: list[dict[str, Any]]) -> Path:
    """Write the messages of a case to one file of the given container."""
    version = CONTAINERS[path.name]
    distro = Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE
    store = get_typestore(distro)
    resolver = TypeResolver(distro.value)
    folder = path.with_suffix("")
    plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    writer = Ros1Writer(path) if version == 1 else Ros2Writer(folder, version=9, storage_plugin=plugin)
    with writer:
        connections = {}
        for message in messages:
            key = (message["topic"], message["type"])
            if key not in connections:
                connections[key] = writer.add_connection(*key, typestore=store)
            at = int((START_S + message["t"]) * 1_000_000_000)
            writer.write(connections[key], at, payload(message, resolver, version))
    if version == 1:
        return path
    return next(folder.glob(f"*{path.suffix}")).rename(path)


def payload(message: dict[str, Any], resolver: TypeResolver, version: int) -> bytes:
    if "raw" in message:
        return bytes.fromhex(message["raw"])
    definition = resolver.resolve(message["type"], None, ros_version=version)
    encoding = Encoding.ROS1 if version == 1 else Encoding.CDR
    values = complete(definition.root, definition, message.get("data", {}))
    return Serializer(definition, encoding).from_dict(values)


def matches(actual: Any, expected: Any) -> bool:
    """Return whether a row contains all expected fields with equal values."""
    if isinstance(expected, dict):
        return isinstance(actual, dict) and all(
            matches(actual.get(key), value) for key, value in expected.items()
        )
    if isinstance(expected, list):
        return len(actual) == len(expected) and all(map(matches, actual, expected))
    if isinstance(expected, float):
        return isinstance(actual, float) and math.isclose(actual, expected, rel_tol=1e-6)
    return actual == expected


def run(folder: Path) -> tuple[Report | None, int, str]:
    try:
        report = api.run(api.compile_job(folder / "job.yaml"))
    except IngestError as error:
        return None, error.exit_code, str(error)
    recording = report.recordings[0]
    return recording, report.exit_code, recording.error or ""


def check_topic(topic: TopicReport, wanted: dict[str, Any], store: Store, sequence: str) -> None:
    rows = wanted.pop("rows", None)
    rules = wanted.pop("rules", None)
    for name, value in wanted.items():
        assert getattr(topic, name) == value, f"{topic.target}: {name}"
    if rules is not None:
        assert {rejection.rule: rejection.count for rejection in topic.rejections} == rules
    if rows is not None:
        actual = store.scan(sequence, topic.target).read_all().to_pylist()
        assert len(actual) == len(rows)
        for one, expected in zip(actual, rows, strict=True):
            assert matches(one, expected), one


def containers(case: Path) -> list[str]:
    return yaml.safe_load((case / "expected.yaml").read_text()).get("containers", list(CONTAINERS))


@pytest.mark.parametrize(
    ("case", "container"),
    [
        pytest.param(case, container, id=f"{case.name}-{Path(container).suffix[1:]}")
        for case in CASES
        for container in containers(case)
    ],
)
@pytest.mark.promise("validated-containers")
def test_job_case_gives_the_expected_result(case: Path, container: str, tmp_path: Path) -> None:
    expected = yaml.safe_load((case / "expected.yaml").read_text())
    messages = yaml.safe_load((case / "messages.yaml").read_text())
    write_recording(tmp_path / container, messages)
    for extra in case.iterdir():
        if extra.name not in {"messages.yaml", "expected.yaml"}:
            text = extra.read_text().replace("RECORDING", container)
            (tmp_path / extra.name).write_text(text)

    report, exit_code, error = run(tmp_path)

    assert expected.get("error", "") in error
    assert exit_code == expected["exit_code"], error
    if report is None:
        return
    assert expected.get("finding", "") in "\n".join(report.findings)
    store = Store.open(tmp_path / "store")
    topics = {topic.target: topic for topic in report.topics}
    for name, wanted in expected.get("topics", {}).items():
        check_topic(topics[name], dict(wanted), store, report.sequence)
    for topic in report.topics:
        assert topic.read == topic.written + topic.filtered + topic.downsampled + topic.rejected
    stored = {info.name for info in store.sequences()}
    assert (report.sequence in stored) == expected.get("stored", True)
