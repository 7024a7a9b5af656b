"""Export from a server: the messages equal those of the recording and of an export from the store."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import foxglove_schemas
import numpy as np
import pyarrow as pa
import pyarrow.flight as fl
import pytest
from flight_calls import Client
from made_recordings import define, record
from message_differences import differences
from mosaicod import Mosaicod, Topic, running
from random_messages import random_rows
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores as RosbagsStores
from rosbags.typesys import get_typestore

from mosaico_ingest.adapters.builtin import BUILTIN, Builtin
from mosaico_ingest.adapters.standalone import DefinitionFinder
from mosaico_ingest.api import run
from mosaico_ingest.destinations import topic_schema
from mosaico_ingest.destinations.server.client import connect
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import BagError, NothingMatched, SinkError
from mosaico_ingest.export import ExportReport, export_sequence
from mosaico_ingest.export.official_bridge import MosaicoToROSLoader, ROSExtractorConfig, ROSSequenceExtractor
from mosaico_ingest.export.sources import ServerSequence, as_type, comparable
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.values import ServerTarget, Stores
from mosaico_ingest.ontology import Integer64
from mosaico_ingest.rosbag.blocks import ROSMessage
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition
from mosaico_ingest.rosbag.loader import ROSLoader
from mosaico_ingest.rosbag.rosbags_library import open_writer
from mosaico_ingest.serve import Server, serve

DRIVE = Path(__file__).parents[2] / "configs" / "quickstart" / "drive.mcap"
MESSAGES = 12


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    with serve(tmp_path / "served", port=0) as started:
        yield started


@pytest.fixture
def platform() -> Iterator[Mosaicod]:
    """A server that is written from the protocol."""
    with running(Mosaicod()) as started:
        yield started


def ingest(port: int, recording: Path, **options: Any) -> None:
    config = ROSInjectionConfig(recording, "s", host="127.0.0.1", port=port, **options)
    report = run([config]).recordings[0]
    assert report.error is None, report.error


def export(port: int, path: Path, **options: Any) -> ExportReport:
    with connect(ServerTarget("127.0.0.1", port)) as client:
        return export_sequence(ServerSequence(client, "s"), "s", path, **options)


@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
def test_export_from_server_messages_equal_the_recording(server: Server, tmp_path: Path, suffix: str) -> None:
    ingest(server.port, DRIVE)
    report = export(server.port, tmp_path / f"out{suffix}")
    assert (report.faithful, report.messages) == (True, 2130)
    assert differences(DRIVE, tmp_path / f"out{suffix}") == {}


def test_export_from_server_ros1_messages_equal_the_recording(server: Server, tmp_path: Path) -> None:
    definition = define("acme_msgs/msg/Timed", "time at\nint16[] values\n", version=1)
    messages = [
        ("/t", definition, at, {"at": {"sec": at, "nanosec": 5}, "values": [at] * at}) for at in range(5)
    ]
    source = record(tmp_path / "in.bag", messages)
    ingest(server.port, source)
    assert export(server.port, tmp_path / "out.bag").faithful
    assert differences(source, tmp_path / "out.bag") == {}


def catalog(distro: Stores) -> Iterator[tuple[Builtin, Definition]]:
    """Yield every built-in adapter with each of its types."""
    finder = DefinitionFinder(distro)
    version = 1 if distro is Stores.ROS1_NOETIC else 2
    for spec in BUILTIN:
        for msgtype in spec.ros_types:
            try:
                definition = finder.find(msgtype, spec)
            except BagError:
                continue
            if definition.ros_version == version:
                yield spec, definition


@pytest.mark.slow
@pytest.mark.parametrize(("distro", "suffix"), [(Stores.LATEST, ".mcap"), (Stores.ROS1_NOETIC, ".bag")])
def test_export_from_server_of_every_builtin_adapter_equals_export_from_store(
    server: Server, tmp_path: Path, distro: Stores, suffix: str
) -> None:
    messages: list[tuple[str, Definition, int, dict[str, Any]]] = []
    overrides: dict[str, str] = {}
    for number, (spec, definition) in enumerate(catalog(distro)):
        topic = f"/{spec.name}/t{number}"
        overrides[topic] = spec.name
        rows = random_rows(ros_shape(definition), MESSAGES, seed=number)
        messages += [(topic, definition, 10 + at, row.as_py()) for at, row in enumerate(rows)]
    assert len({spec.name for spec, _ in catalog(distro)}) > 30
    source = record(tmp_path / f"in{suffix}", sorted(messages, key=lambda message: message[2]))
    options: dict[str, Any] = {"adapter_override": overrides, "topics_on_error": "ignore"}
    ingest(server.port, source, **options)
    config = ROSInjectionConfig(source, "s", store=tmp_path / "store", **options)
    assert run([config]).recordings[0].error is None
    served = export(server.port, tmp_path / f"served{suffix}")
    stored = export_sequence(Store.open(tmp_path / "store"), "s", tmp_path / f"stored{suffix}")
    assert served.topics == stored.topics
    assert {topic.topic for topic in served.topics if not topic.excluded} == set(overrides)
    assert differences(tmp_path / f"stored{suffix}", tmp_path / f"served{suffix}") == {}


def as_served(kind: Any) -> Any:
    """Return an Arrow type as the platform's server returns it: nullable, with views."""
    if pa.types.is_struct(kind):
        return pa.struct([pa.field(field.name, as_served(field.type), nullable=True) for field in kind])
    if pa.types.is_fixed_size_list(kind):
        return pa.list_(as_served(kind.value_type), kind.list_size)
    if pa.types.is_list(kind):
        return pa.list_(as_served(kind.value_type))
    return {pa.string(): pa.string_view(), pa.binary(): pa.binary_view()}.get(kind, kind)


def served_batch(batch: pa.RecordBatch) -> pa.RecordBatch:
    fields = [pa.field(field.name, as_served(field.type)) for field in batch.schema]
    columns = [as_type(batch.column(field.name), field.type) for field in fields]
    return pa.RecordBatch.from_arrays(columns, schema=pa.schema(fields))


def test_export_from_platform_with_views_and_nullable_columns_equals_the_recording(
    platform: Mosaicod, tmp_path: Path
) -> None:
    def rows_sent(topic: Topic) -> fl.FlightDataStream:
        batches = [served_batch(chunk) for chunk in topic.chunks]
        return fl.GeneratorStream(batches[0].schema, iter(batches))

    ingest(platform.port, DRIVE)
    platform.faults.rows_sent = rows_sent
    platform.faults.columns_sent = lambda topic: served_batch(topic.chunks[0]).schema
    assert export(platform.port, tmp_path / "out.mcap").faithful
    assert differences(DRIVE, tmp_path / "out.mcap") == {}


def test_export_from_server_before_0_7_reads_the_metadata_of_the_schemas(
    platform: Mosaicod, tmp_path: Path
) -> None:
    platform.faults.version, platform.faults.metadata_in_schema = "0.6.0", True
    ingest(platform.port, DRIVE, topics=["/imu", "/battery"])
    assert export(platform.port, tmp_path / "out.mcap").faithful
    assert differences(DRIVE, tmp_path / "out.mcap", topics=["/imu", "/battery"]) == {}


@pytest.mark.parametrize("kind", ["list", "large_list", "fixed", "struct"])
def test_as_type_restores_nulls_and_nested_values(kind: str) -> None:
    element = pa.struct([pa.field("a", pa.string(), nullable=False), pa.field("b", pa.list_(pa.int8()))])
    item = {"a": "x", "b": [1, None]}
    target, values = {
        "list": (pa.list_(pa.field("item", element, nullable=False)), [[item], None, [], [item, item]]),
        "large_list": (pa.large_list(element), [None, [item]]),
        "fixed": (pa.list_(element, 2), [[item, item], None]),
        "struct": (pa.struct([pa.field("inner", element)]), [{"inner": None}, None, {"inner": item}]),
    }[kind]
    array = pa.array(values, comparable(target))
    restored = as_type(array, target)
    restored.validate(full=True)
    assert restored.type == target
    assert restored.to_pylist() == values


def test_as_type_of_another_type_raises() -> None:
    with pytest.raises(SinkError, match="column x is string"):
        as_type(pa.array(["word"]), pa.int64(), "x")


def test_export_from_server_starts_before_the_last_rows_are_sent(platform: Mosaicod) -> None:
    schema = topic_schema(Integer64.ontology_type())
    batch = pa.RecordBatch.from_arrays(
        [pa.array(np.arange(3)), *(pa.nulls(3, field.type) for field in list(schema)[1:])], schema=schema
    )
    consumed = threading.Event()

    def rows_sent(topic: Topic) -> fl.FlightDataStream:
        def batches() -> Iterator[pa.RecordBatch]:
            yield batch
            assert consumed.wait(20), f"{topic.locator} is read ahead"
            yield batch

        return fl.GeneratorStream(schema, batches())

    ingest(platform.port, DRIVE, topics=["/imu"])
    platform.faults.rows_sent = rows_sent
    with connect(ServerTarget("127.0.0.1", platform.port)) as client:
        rows = client.rows("s/imu")
        assert next(rows).num_rows == 3
        consumed.set()
        assert sum(received.num_rows for received in rows) == 3


def test_export_from_server_broken_stream_raises_and_leaves_no_file(
    platform: Mosaicod, tmp_path: Path
) -> None:
    def rows_sent(topic: Topic) -> fl.FlightDataStream:
        def batches() -> Iterator[pa.RecordBatch]:
            yield topic.chunks[0]
            raise fl.FlightServerError("the disk failed")

        return fl.GeneratorStream(topic.chunks[0].schema, batches())

    ingest(platform.port, DRIVE, topics=["/imu"])
    platform.faults.rows_sent = rows_sent
    with pytest.raises(SinkError, match="the disk failed"):
        export(platform.port, tmp_path / "out.mcap")
    assert list(tmp_path.iterdir()) == []


def test_export_from_server_open_upload_is_excluded(server: Server, tmp_path: Path) -> None:
    ingest(server.port, DRIVE, topics=["/imu"])
    with Client(server) as client:
        session = client.call("session_create", locator="s")["uuid"]
        client.create_topic(session, "s/open")
        report = export(server.port, tmp_path / "out.mcap")
    excluded: Mapping[str, str] = {topic.topic: topic.excluded for topic in report.topics}
    assert excluded["/imu"] == ""
    assert "not finished" in excluded["/open"]


def test_export_from_server_unknown_sequence_names_the_nearest(server: Server) -> None:
    ingest(server.port, DRIVE, topics=["/imu"])
    with (
        connect(ServerTarget("127.0.0.1", server.port)) as client,
        pytest.raises(SinkError, match="there is no sequence 'ss' — the nearest is s"),
    ):
        ServerSequence(client, "ss")


def test_export_from_server_of_protobuf_and_json_equals_export_from_store(
    server: Server, tmp_path: Path
) -> None:
    source = tmp_path / "in.mcap"
    with open_writer(source) as writer:
        for at, (name, values) in enumerate(foxglove_schemas.MESSAGES.items()):
            for form, definition, payload in (
                (
                    "protobuf",
                    foxglove_schemas.protobuf_definition(name),
                    foxglove_schemas.protobuf_payload(name, values),
                ),
                ("json", foxglove_schemas.json_definition(name), foxglove_schemas.json_payload(values)),
            ):
                writer.write(writer.add_connection(f"/{form}/{name}", definition), 10 + at, payload)
    ingest(server.port, source)
    report = run([ROSInjectionConfig(source, "s", store=tmp_path / "store")]).recordings[0]
    assert report.error is None
    served = export(server.port, tmp_path / "served.mcap")
    stored = export_sequence(Store.open(tmp_path / "store"), "s", tmp_path / "stored.mcap")
    assert served.topics == stored.topics
    assert len([topic for topic in served.topics if not topic.excluded]) == 2 * len(foxglove_schemas.MESSAGES)
    assert (tmp_path / "served.mcap").read_bytes() == (tmp_path / "stored.mcap").read_bytes()


@pytest.mark.parametrize(
    ("plugin", "name"), [(StoragePlugin.MCAP, "s.mcap"), (StoragePlugin.SQLITE3, "s.db3"), ("mcap", "s.mcap")]
)
def test_extractor_writes_the_recording_in_the_folder_of_the_sequence(
    server: Server, tmp_path: Path, plugin: Any, name: str
) -> None:
    ingest(server.port, DRIVE)
    config = ROSExtractorConfig(
        saving_path=tmp_path / "out",
        sequence_name="s",
        port=server.port,
        topics=["/imu", "/battery"],
        ros_distro=RosbagsStores.ROS2_HUMBLE,
        storage_plugin=plugin,
    )
    preview = ROSSequenceExtractor(replace(config, dry_run=True)).run()
    assert ([topic.msgtype for topic in preview.topics], (tmp_path / "out").exists()) == (
        ["acme_msgs/msg/BatteryPack", "sensor_msgs/msg/Imu"],
        False,
    )
    assert ROSSequenceExtractor(config).run().messages == 1010
    path = tmp_path / "out" / "s" / name
    assert differences(DRIVE, path, topics=["/imu", "/battery"]) == {}
    with pytest.raises(BagError, match="exists"):
        ROSSequenceExtractor(config).run()
    assert ROSSequenceExtractor(replace(config, overwrite=True)).run().messages == 1010


def test_extractor_path_follows_distro_and_plugin() -> None:
    assert ROSExtractorConfig("out", "s", ros_distro="ros1_noetic").path == Path("out/s/s.bag")
    with pytest.raises(BagError, match="unknown storage plugin 'bag'"):
        _ = ROSExtractorConfig("out", "s", storage_plugin="bag").path


@pytest.mark.parametrize(("level", "logged"), [("WARNING", 1), ("ERROR", 0)])
def test_extractor_log_level_selects_messages_of_the_log(
    server: Server, tmp_path: Path, caplog: pytest.LogCaptureFixture, level: str, logged: int
) -> None:
    ingest(server.port, DRIVE, topics=["/imu", "/battery"])
    with Store.open(tmp_path / "served").catalog.write() as db:
        db.execute("UPDATE topics SET metadata = '{}' WHERE name = '/battery'")
    config = ROSExtractorConfig(tmp_path / "out", "s", port=server.port, log_level=level, dry_run=True)
    ROSSequenceExtractor(config).run()
    messages = [record.args for record in caplog.records if record.name == "mosaico_ingest.export.export"]
    assert [args[:2] for args in messages if args] == [("/battery", "s")] * logged


def test_extractor_uses_custom_msgs_for_topics_without_definition(server: Server, tmp_path: Path) -> None:
    ingest(server.port, DRIVE, topics=["/imu"])
    store = Store.open(tmp_path / "served")
    with store.catalog.write() as db:
        db.execute("UPDATE topics SET metadata = '{}'")
    folder = tmp_path / "sensor_msgs"
    folder.mkdir()
    (folder / "Imu.msg").write_text(
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
        "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
        "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\nuint8 own\n"
    )
    config = ROSExtractorConfig(
        tmp_path / "out", "s", port=server.port, custom_msgs=[("sensor_msgs", folder, None)]
    )
    (topic,) = ROSSequenceExtractor(config).run().topics
    assert topic.assumed.startswith("sensor_msgs/msg/Imu of ")
    assert topic.defaulted == ("own",)


def by_topic(messages: Iterable[ROSMessage]) -> list[tuple[str, int, str, str]]:
    """Return messages by topic and time, which are comparable if a value is NaN."""
    return sorted(
        (message.topic, message.bag_timestamp_ns, message.msg_type, repr(message.data))
        for message in messages
    )


def test_loader_of_a_server_yields_the_messages_of_the_recording(server: Server) -> None:
    topics = ["/imu", "/tf", "/battery", "/lidar/points"]
    ingest(server.port, DRIVE, topics=[*topics, "/odom"])
    with connect(ServerTarget("127.0.0.1", server.port)) as client:
        with MosaicoToROSLoader(client, None, "s", topics) as loader:
            pairs = list(loader)
        counts = loader.msg_count(), loader.msg_count("/imu")
        with pytest.raises(NothingMatched, match="/odom"):
            loader.msg_count("/odom")
    restored = [message for _, message in pairs]
    assert [topic for topic, _ in pairs] == [message.topic for message in restored]
    with ROSLoader(DRIVE, topics=topics) as recording:
        assert by_topic(restored) == by_topic(message for message, _ in recording)
        assert (loader.topics, loader.duration > 0) == (recording.topics, True)
    assert counts == (len(restored), 1000)
    times = [message.bag_timestamp_ns for message in restored]
    assert times == sorted(times)
    assert (loader.filtered_topics, loader.rejected_topics) == (["/odom"], {})
    assert loader.resolve_native_msg_type("/imu") == "sensor_msgs/msg/Imu"


def test_loader_of_a_store_applies_the_time_range_and_names_rejected_topics(
    server: Server, tmp_path: Path
) -> None:
    ingest(server.port, DRIVE, topics=["/imu", "/battery"])
    store = Store.open(tmp_path / "served")
    with store.catalog.write() as db:
        db.execute("UPDATE topics SET metadata = '{}'")
    start = store.sequence("s").start_ns or 0
    typestore = get_typestore(RosbagsStores.ROS2_HUMBLE)
    loader = MosaicoToROSLoader(store, typestore, "s", None, start, start + 10**9)
    assert {message.msg_type for _, message in loader} == {"sensor_msgs/msg/Imu"}
    assert loader.msg_count() == len(list(loader)) == 100
    assert list(loader.rejected_topics) == ["/battery"]
