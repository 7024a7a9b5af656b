"""The official SDK against `ingest serve`: reading, writing and queries."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import pytest
from message_differences import differences as message_differences
from rosbags.typesys import Stores as RosbagsStores

from mosaico_ingest.api import RosbagInjector
from mosaico_ingest.destinations.server.client import connect
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.export import export_sequence
from mosaico_ingest.export.official_bridge import MosaicoToROSLoader
from mosaico_ingest.export.sources import ServerSequence
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.values import ServerTarget
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.protocol.messages import Permission
from mosaico_ingest.serve import Keyring, Server, serve

pytestmark = pytest.mark.interop
sdk = pytest.importorskip("mosaicolabs", reason="the official SDK is not installed")
from mosaicolabs.models.sensors import GPS, IMU  # noqa: E402 - only once it is known to be there
from mosaicolabs.query import QueryOntologyCatalog, QuerySequence, QueryTopic  # noqa: E402 - the same

RECORDING = Path(__file__).resolve().parents[2] / "configs/quickstart/drive.mcap"
CORPUS = "rerun-io__rerun/rosbag2_2025_09_10-13_03_56_0.mcap"


@dataclass(frozen=True)
class Different:
    """What the official injector stores otherwise, and why we do not."""

    topic: str
    what: str
    """`type`, a column, or `metadata.<key>`; a glob."""
    why: str


DIFFERENT = (
    Different("*/image*", "data", "pixels are kept as they are; the SDK makes a PNG of them"),
    Different("*/image*", "format", "the same"),
    Different("*compressed*", "metadata.ros_format", "what the message says beyond the codec is kept"),
    Different("/range", "type", "the SDK has the type and no adapter for it, so it keeps the ROS shape"),
)


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server whose store has the recording twice: `ours` and, by the official injector, `theirs`."""
    with serve(tmp_path_factory.mktemp("served"), port=0) as server:
        ingest(server, RECORDING, "ours", "theirs")
        yield server


def ingest(server: Server, recording: Path, ours: str, theirs: str) -> None:
    RosbagInjector(ROSInjectionConfig(recording, ours, store=server.store_path)).run()
    injector = Path(sys.executable).with_name("mosaicolabs.ros_injector")
    command = [str(injector), str(recording), "--name", theirs, "--port", str(server.port)]
    subprocess.run(command, check=True, capture_output=True)  # noqa: S603 - the SDK's own command


@pytest.fixture(scope="module")
def client(served: Server) -> Iterator[Any]:
    with sdk.MosaicoClient.connect("127.0.0.1", served.port) as connected:
        yield connected


def bare(value: object) -> object:
    """Return the value as the SDK shows it: a struct without any value is none, and NaN equals itself."""
    if isinstance(value, dict):
        kept = {key: inner for key, child in value.items() if (inner := bare(child)) is not None}
        return kept or None
    if isinstance(value, list | tuple):
        return [bare(child) for child in value]
    return "NaN" if isinstance(value, float) and math.isnan(value) else value


def shown(message: Any) -> object:
    data = message.data
    return bare(data.raw_data if hasattr(data, "raw_data") else data.model_dump())


def check_read_back(client: Any, store: Store, sequence: str) -> None:
    """Every row comes back as an object of the class the SDK has for its tag, with equal values."""
    handler = client.sequence_handler(sequence)
    assert handler.topics == [topic.name for topic in store.sequence(sequence).topics]
    for topic in store.sequence(sequence).topics:
        rows = store.scan(sequence, topic.name).read_all().to_pylist(maps_as_pydicts="strict")
        messages = list(handler.get_topic_handler(topic.name).get_data_streamer())
        assert [message.timestamp_ns for message in messages] == [row.pop("timestamp_ns") for row in rows]
        assert [shown(message) for message in messages] == [bare(row) for row in rows], topic.name
        known = getattr(sdk, topic.ontology.tag, None)
        if known is not None and type(messages[0].data) is not known:
            assert "__" in type(messages[0].data).__name__, f"{topic.name} came back untyped"


def differences(store: Store, ours: str, theirs: str) -> set[tuple[str, str]]:
    """Return topic and column, or metadata key, of all that is not equal."""
    mine = {topic.name: topic for topic in store.sequence(ours).topics}
    other = {topic.name: topic for topic in store.sequence(theirs).topics}
    assert list(mine) == list(other)
    actual: set[tuple[str, str]] = set()
    for name, topic in mine.items():
        if kind_of(topic.ontology) != kind_of(other[name].ontology):
            actual.add((name, "type"))
            continue
        keys = topic.metadata.keys() | other[name].metadata.keys()
        actual |= {
            (name, f"metadata.{key}")
            for key in keys
            if topic.metadata.get(key) != other[name].metadata.get(key)
        }
        columns = [store.scan(sequence, name).read_all().to_pydict() for sequence in (ours, theirs)]
        assert list(columns[0]) == list(columns[1])
        actual |= {
            (name, column) for column in columns[0] if bare(columns[0][column]) != bare(columns[1][column])
        }
    return actual


def kind_of(ontology: OntologyType) -> tuple[object, ...]:
    return ontology.tag, ontology.fingerprint, ontology.serialization_format


def unexplained(found: set[tuple[str, str]]) -> set[tuple[str, str]]:
    return {
        (topic, what)
        for topic, what in found
        if not any(fnmatchcase(topic, known.topic) and fnmatchcase(what, known.what) for known in DIFFERENT)
    }


def test_sdk_lists_and_describes_ingested_sequences(served: Server, client: Any) -> None:
    info = Store.open(served.store_path).sequence("ours")
    handler = client.sequence_handler("ours")
    assert sorted(client.list_sequences()) == ["ours", "theirs"]
    assert (handler.timestamp_ns_min, handler.timestamp_ns_max) == (info.start_ns, info.end_ns)
    assert handler.total_size_bytes == info.stored_bytes
    imu = handler.get_topic_handler("/imu")
    assert (imu.ontology_tag, imu.user_metadata) == (
        "IMU",
        Store.open(served.store_path).topic("ours", "imu").metadata,
    )


def test_sdk_reads_every_row_typed_and_equal(served: Server, client: Any) -> None:
    check_read_back(client, Store.open(served.store_path), "ours")


def test_sdk_streams_a_sequence_in_time_order(served: Server, client: Any) -> None:
    info = Store.open(served.store_path).sequence("ours")
    assert info.start_ns is not None
    stamps = [message.timestamp_ns for _, message in client.sequence_handler("ours").get_data_streamer()]
    assert stamps == sorted(stamps)
    assert len(stamps) == info.rows
    start, end = info.start_ns + 10**9, info.start_ns + 2 * 10**9
    part = client.sequence_handler("ours").get_data_streamer(start_timestamp_ns=start, end_timestamp_ns=end)
    assert [message.timestamp_ns for _, message in part] == [
        stamp for stamp in stamps if start <= stamp < end
    ]


def test_both_injectors_store_the_same_except_listed_differences(served: Server) -> None:
    assert unexplained(differences(Store.open(served.store_path), "ours", "theirs")) == set()


@pytest.mark.slow
def test_both_injectors_store_a_real_recording_equally(served: Server, client: Any, corpus: Path) -> None:
    ingest(served, corpus / CORPUS, "sensors", "sensors_theirs")
    store = Store.open(served.store_path)
    check_read_back(client, store, "sensors")
    assert unexplained(differences(store, "sensors", "sensors_theirs")) == set()


@pytest.mark.parametrize("low", [-1e9, -0.5, 0.0, 0.5, 9.0, 1e9])
def test_sdk_query_builder_finds_the_same_as_a_scan(served: Server, client: Any, low: float) -> None:
    store = Store.open(served.store_path)
    expected = set()
    for sequence in ("ours", "theirs"):
        rows = store.scan(sequence, "/imu").read_all().to_pylist()
        if any(
            (row["acceleration"]["x"] or 0) > low and row["timestamp_ns"] > rows[10]["timestamp_ns"]
            for row in rows
        ):
            expected.add((sequence, "/imu"))
    after = store.scan("ours", "/imu").read_all()["timestamp_ns"][10].as_py()
    response = client.query(QueryOntologyCatalog(IMU.Q.acceleration.x.gt(low), IMU.Q.timestamp_ns.gt(after)))
    assert {(item.sequence.name, topic.name) for item in response for topic in item.topics} == expected


def test_sdk_query_builder_selects_by_name_tag_and_metadata(client: Any) -> None:
    response = client.query(
        QuerySequence().with_name_match("o*"), QueryTopic().with_ontology_tag("IMU"), QueryOntologyCatalog()
    )
    assert [(item.sequence.name, [topic.name for topic in item.topics]) for item in response] == [
        ("ours", ["/imu"])
    ]
    again = client.query(response.to_query_sequence(), QueryTopic().with_name_match("/gps/*"))
    assert [[topic.ontology_tag for topic in item.topics] for item in again] == [["GPS"]]
    narrowed = client.query(again.to_query_topic(), QueryOntologyCatalog(GPS.Q.position.z.gt(-1e6)))
    assert {item.sequence.name for item in narrowed} == {"ours", "theirs"}
    by_key = client.query(QuerySequence().with_user_metadata("rosbag_injection", eq=RECORDING.name))
    assert [item.sequence.name for item in by_key] == ["theirs"]


def test_sdk_clusters_and_intersects_topics_of_a_query(served: Server, client: Any) -> None:
    store = Store.open(served.store_path)
    rows = {
        name: store.scan("ours", name).read_all()["timestamp_ns"].to_pylist() for name in ("/imu", "/gps/fix")
    }
    high = rows["/imu"][-1] - rows["/imu"][0]
    response = client.query(
        QuerySequence().with_name("ours"),
        QueryOntologyCatalog(IMU.Q.timestamp_ns.geq(0), GPS.Q.timestamp_ns.geq(0)),
    )
    topics = {topic.name: topic for item in response for topic in item.topics}

    def spans(clusters: Any) -> list[tuple[int, int]]:
        return [(cluster.timerange.start, cluster.timerange.end) for cluster in clusters]

    for name, times in rows.items():
        assert spans(topics[name].clusterize()) == [(times[0], times[-1])]
        assert len(topics[name].clusterize(1)) == len(set(times))
        assert spans(topics[name].clusterize(high)) == [(times[0], times[-1])]
    common = (max(times[0] for times in rows.values()), min(times[-1] for times in rows.values()))
    assert spans(topics["/imu"].intersect(topics["/gps/fix"])) == [common]


def test_sdk_writes_notifications_and_deletes(client: Any) -> None:
    stamp = sdk.Time(seconds=1, nanoseconds=0)
    with client.sequence_create(
        "written", {"by": "hand"}, on_error=sdk.SessionLevelErrorPolicy.Report
    ) as sequence:
        writer = sequence.topic_create("/accelerations", {"unit": "m/s2"}, IMU)
        for number in range(5):
            vector = sdk.Vector3d(x=float(number), y=0.0, z=9.81)
            imu = IMU(
                acceleration=vector, angular_velocity=vector, header=sdk.Header(timestamp=stamp, frame_id="a")
            )
            writer.push(sdk.Message(timestamp_ns=number, data=imu))
    handler = client.sequence_handler("written")
    assert handler.user_metadata == {"by": "hand"}
    stream = handler.get_topic_handler("/accelerations").get_data_streamer()
    assert [message.data.acceleration.x for message in stream] == [0.0, 1.0, 2.0, 3.0, 4.0]
    client.sequence_delete("written")
    assert "written" not in client.list_sequences()


def test_error_inside_the_sdk_leaves_its_notification(client: Any) -> None:
    with (
        pytest.raises(ZeroDivisionError),
        client.sequence_create("failed", {}, on_error=sdk.SessionLevelErrorPolicy.Report) as sequence,
    ):
        sequence.topic_create("/imu", {}, IMU)
        raise ZeroDivisionError
    assert len(client.list_sequence_notifications("failed")) == 1
    client.clear_sequence_notifications("failed")
    assert client.list_sequence_notifications("failed") == []
    with (
        pytest.raises(ZeroDivisionError),
        client.sequence_create("dropped", {}, on_error=sdk.SessionLevelErrorPolicy.Delete) as sequence,
    ):
        sequence.topic_create("/imu", {}, IMU)
        raise ZeroDivisionError
    assert "dropped" not in client.list_sequences()


def test_sdk_is_accepted_with_a_key_and_refused_without(tmp_path: Path) -> None:
    ring = Keyring(tmp_path / "keys.json")
    key = ring.add(Permission.READ)
    with serve(tmp_path / "store", port=0, keys=ring) as server:
        with sdk.MosaicoClient.connect("127.0.0.1", server.port, api_key=key) as client:
            assert client.list_sequences() == []
        with pytest.raises(Exception, match=r"API key|onnect"):
            sdk.MosaicoClient.connect("127.0.0.1", server.port, timeout=1)


def test_export_of_sequence_uploaded_by_the_sdk_equals_the_recording(served: Server, tmp_path: Path) -> None:
    with connect(ServerTarget("127.0.0.1", served.port)) as connected:
        source = ServerSequence(connected, "theirs")
        report = export_sequence(source, "theirs", tmp_path / "out.mcap")
    assert [topic.topic for topic in report.topics if topic.excluded or topic.assumed] == []
    assert {topic.topic: topic.changed for topic in report.topics if topic.changed} == {}
    # The SDK stores the codec only, and not the text of the message.
    listed = {"/camera/image_raw/compressed": {"format"}}
    assert message_differences(RECORDING, tmp_path / "out.mcap") == listed


def test_both_sequence_loaders_yield_the_same_topics_and_times(served: Server, client: Any) -> None:
    bridge = pytest.importorskip(
        "mosaicolabs.bridges.ros", reason="the SDK has no loader of sequences before 0.7"
    )

    def pairs(loader: Any) -> list[tuple[str, int]]:
        with loader:
            return [(topic, message.timestamp_ns) for topic, message in loader]

    topics = ["/imu", "/odom"]
    with connect(ServerTarget("127.0.0.1", served.port)) as own_client:
        ours = pairs(MosaicoToROSLoader(own_client, RosbagsStores.ROS2_HUMBLE, "ours", topics))
    assert ours == pairs(bridge.MosaicoToROSLoader(client, RosbagsStores.ROS2_HUMBLE, "ours", topics))
    assert {topic for topic, _ in ours} == set(topics)
