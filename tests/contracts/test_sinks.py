"""The common behavior of all sinks: rows are visible after the commit, and only then."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, ClassVar, Protocol

import pyarrow as pa
import pytest
from mosaicod import Mosaicod, running
from object_store import ObjectStore

from mosaico_ingest.destinations import AmendableSession, Sink, topic_schema
from mosaico_ingest.destinations.memory import MemorySink
from mosaico_ingest.destinations.server.destination import ServerSink
from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.errors import SequenceExists, SinkError
from mosaico_ingest.job.values import IfExists, ServerTarget
from mosaico_ingest.ontology.registry import OntologyType, SerializationFormat
from mosaico_ingest.remote import AnyPath, as_path
from mosaico_ingest.serve import serve

POINT = OntologyType(
    "Point",
    pa.struct(
        [
            pa.field("x", pa.float64(), nullable=False),
            pa.field("name", pa.string()),
            pa.field("raw", pa.list_(pa.field("item", pa.uint8(), nullable=False))),
        ]
    ),
)
FLAG = OntologyType("Flag", pa.struct([pa.field("on", pa.bool_())]))


class Destination(Protocol):
    """A sink, and the way a reader looks at what it wrote."""

    keeps_old: ClassVar[bool]
    """Whether `append` adds rows to a topic, and `replace` keeps the old sequence until the commit."""

    @property
    def sink(self) -> Sink: ...
    def sequences(self) -> Sequence[str]: ...
    def metadata(self, sequence: str) -> Mapping[str, Any]: ...
    def topics(self, sequence: str) -> Mapping[str, tuple[OntologyType, Mapping[str, Any]]]: ...
    def rows(self, sequence: str, topic: str) -> pa.Table: ...
    def errors(self, sequence: str) -> Sequence[tuple[str | None, str]]: ...


class InMemory:
    keeps_old = True

    def __init__(self) -> None:
        self.sink = MemorySink()

    def sequences(self) -> Sequence[str]:
        return sorted(self.sink.sequences)

    def metadata(self, sequence: str) -> Mapping[str, Any]:
        return self.sink.sequences[sequence].metadata

    def topics(self, sequence: str) -> Mapping[str, tuple[OntologyType, Mapping[str, Any]]]:
        topics = self.sink.sequences[sequence].topics
        return {name: (topic.ontology, topic.metadata) for name, topic in topics.items()}

    def rows(self, sequence: str, topic: str) -> pa.Table:
        return self.sink.sequences[sequence].topics[topic].table().sort_by("timestamp_ns")

    def errors(self, sequence: str) -> Sequence[tuple[str | None, str]]:
        return self.sink.sequences[sequence].errors


class InStore:
    keeps_old = True

    def __init__(self, folder: AnyPath) -> None:
        self.store = Store.open(folder / "mosaico")
        self.sink = StoreSink(self.store)

    def sequences(self) -> Sequence[str]:
        return [info.name for info in self.store.sequences()]

    def metadata(self, sequence: str) -> Mapping[str, Any]:
        return self.store.sequence(sequence).metadata

    def topics(self, sequence: str) -> Mapping[str, tuple[OntologyType, Mapping[str, Any]]]:
        topics = self.store.sequence(sequence).topics
        return {topic.name: (topic.ontology, topic.metadata) for topic in topics}

    def rows(self, sequence: str, topic: str) -> pa.Table:
        return self.store.scan(sequence, topic).read_all()

    def errors(self, sequence: str) -> Sequence[tuple[str | None, str]]:
        return [(note.topic, note.message) for note in self.store.sequence(sequence).notes]


class OnServer:
    keeps_old = False

    def __init__(self, server: Mosaicod) -> None:
        self.server = server
        self.sink = ServerSink(ServerTarget("127.0.0.1", server.port))

    def sequences(self) -> Sequence[str]:
        open_ones = {session.sequence for session in self.server.sessions.values() if not session.final}
        return sorted(set(self.server.sequences) - open_ones)

    def metadata(self, sequence: str) -> Mapping[str, Any]:
        return self.server.sequences[sequence]

    def topics(self, sequence: str) -> Mapping[str, tuple[OntologyType, Mapping[str, Any]]]:
        return {
            name.removeprefix(sequence): (
                OntologyType(
                    topic.tag, pa.struct(list(topic.table().schema)[1:]), SerializationFormat(topic.format)
                ),
                topic.metadata,
            )
            for name, topic in self.server.topics.items()
            if name.startswith(f"{sequence}/")
        }

    def rows(self, sequence: str, topic: str) -> pa.Table:
        return self.server.topics[f"{sequence}{topic}"].table().sort_by("timestamp_ns")

    def errors(self, sequence: str) -> Sequence[tuple[str | None, str]]:
        return [
            (locator.removeprefix(sequence) or None, message)
            for locator, messages in self.server.notes.items()
            for message in messages
        ]


class OnServedStore(InStore):
    """The same server protocol, answered by our own server over a store."""

    keeps_old = False

    def __init__(self, folder: Path, port: int) -> None:
        super().__init__(folder)
        self.sink = ServerSink(ServerTarget("127.0.0.1", port))

    def sequences(self) -> Sequence[str]:
        written_to = self.store.layout.open_sessions()
        return [info.name for info in self.store.sequences() if info.sessions or not written_to]


@contextmanager
def in_memory(_: Path) -> Generator[Destination, None, None]:
    yield InMemory()


@contextmanager
def in_store(folder: Path) -> Generator[Destination, None, None]:
    yield InStore(folder)


@contextmanager
def in_bucket(folder: Path, objects: ObjectStore) -> Generator[Destination, None, None]:
    yield InStore(as_path(objects.url(folder.name)))


@contextmanager
def on_server(_: Path) -> Generator[Destination, None, None]:
    with running(Mosaicod()) as server:
        yield OnServer(server)


@contextmanager
def on_served_store(folder: Path) -> Generator[Destination, None, None]:
    with serve(folder / "mosaico", port=0) as server:
        yield OnServedStore(folder, server.port)


BY_URL = pytest.param(in_bucket, marks=pytest.mark.slow, id="in_bucket")


@pytest.fixture(
    params=(in_memory, in_store, BY_URL, on_server, on_served_store), ids=lambda make: make.__name__
)
def there(request: pytest.FixtureRequest, tmp_path: Path) -> Generator[Destination, None, None]:
    needs = (request.getfixturevalue("objects"),) if request.param is in_bucket else ()
    result: AbstractContextManager[Destination] = request.param(tmp_path, *needs)
    with result as destination:
        yield destination


@pytest.fixture
def keeping(there: Destination) -> Destination:
    if not there.keeps_old:
        pytest.skip("a server adds no rows to a topic that is there, and has no way to swap sequences")
    return there


class CrashError(Exception):
    """Something goes wrong in the middle of a session."""


def points(*times: int) -> pa.RecordBatch:
    rows = [
        {"timestamp_ns": time, "x": time / 2, "name": f"p{time}" if time % 2 else None, "raw": [time % 256]}
        for time in times
    ]
    return pa.RecordBatch.from_pylist(rows, topic_schema(POINT))


def write(
    there: Destination, *times: int, sequence: str = "drive", if_exists: IfExists = IfExists.FAIL
) -> None:
    with there.sink.open(sequence, {"car": 7}, if_exists=if_exists) as session:
        session.topic("/gps/fix", POINT, {"mount": "roof"}).write(points(*times))


def test_sink_written_rows_are_visible_after_the_commit(there: Destination) -> None:
    with there.sink.open("drive", {"car": {"wheels": [4, 4.5, None]}}) as session:
        writer = session.topic("/gps/fix", POINT, {"mount": "roof"})
        writer.write(points(1, 2))
        session.topic("imu", FLAG, {})
        writer.write(points(3))
    assert there.sequences() == ["drive"]
    assert there.metadata("drive") == {"car": {"wheels": [4, 4.5, None]}}
    assert there.topics("drive") == {"/gps/fix": (POINT, {"mount": "roof"}), "/imu": (FLAG, {})}
    assert there.rows("drive", "/gps/fix").equals(pa.Table.from_batches([points(1, 2, 3)]))


def test_session_stored_returns_the_content_of_the_destination(there: Destination) -> None:
    with there.sink.open("drive", {}) as session:
        session.topic("/gps/fix", POINT, {}).write(points(5, 3, 4))
        session.topic("imu", FLAG, {})
    fix, imu = session.stored()
    assert (fix.topic, fix.rows, fix.start_ns, fix.end_ns) == ("/gps/fix", 3, 3, 5)
    assert (imu.topic, imu.rows, imu.start_ns, imu.end_ns) == ("imu", 0, None, None)
    assert fix.stored_bytes > 0


def test_sink_shows_nothing_before_the_commit(there: Destination) -> None:
    with there.sink.open("drive", {}) as session:
        session.topic("/gps/fix", POINT, {}).write(points(1))
        assert there.sequences() == []


def test_sink_exception_in_session_leaves_nothing(there: Destination) -> None:
    with pytest.raises(CrashError), there.sink.open("drive", {}) as session:
        session.topic("/gps/fix", POINT, {}).write(points(1))
        raise CrashError
    assert there.sequences() == []
    write(there, 1)


def test_sink_rows_are_read_in_time_order(there: Destination) -> None:
    with there.sink.open("drive", {}) as session:
        writer = session.topic("/gps/fix", POINT, {})
        for times in ((7, 9, 8), (1,), (), (5, 2)):
            writer.write(points(*times))
    assert there.rows("drive", "/gps/fix").equals(pa.Table.from_batches([points(1, 2, 5, 7, 8, 9)]))


def test_sink_empty_session_creates_an_empty_sequence(there: Destination) -> None:
    with there.sink.open("drive", {"car": 7}):
        pass
    assert there.sequences() == ["drive"]
    assert there.topics("drive") == {}


@pytest.mark.parametrize("if_exists", [IfExists.FAIL, IfExists.SKIP])
def test_sink_existing_name_is_refused_immediately(there: Destination, if_exists: IfExists) -> None:
    write(there, 1)
    with pytest.raises(SequenceExists, match="drive"), there.sink.open("drive", {}, if_exists=if_exists):
        pytest.fail("the session opened")
    assert there.rows("drive", "/gps/fix").num_rows == 1


def test_sink_append_adds_a_session(keeping: Destination) -> None:
    write(keeping, 1, 4)
    with keeping.sink.open("drive", {"car": 8}, if_exists=IfExists.APPEND) as session:
        session.topic("/gps/fix", POINT, {}).write(points(2, 3))
        session.topic("/flag", FLAG, {})
    assert keeping.rows("drive", "/gps/fix").equals(pa.Table.from_batches([points(1, 2, 3, 4)]))
    assert keeping.metadata("drive") == {"car": 7}
    assert [topic.rows for topic in session.stored()] == [2, 0]


def test_sink_append_adds_topics(there: Destination) -> None:
    write(there, 1)
    with there.sink.open("drive", {"car": 8}, if_exists=IfExists.APPEND) as session:
        session.topic("/flag", FLAG, {})
    assert there.rows("drive", "/gps/fix").equals(pa.Table.from_batches([points(1)]))
    assert set(there.topics("drive")) == {"/gps/fix", "/flag"}
    assert there.metadata("drive") == {"car": 7}
    assert [topic.rows for topic in session.stored()] == [0]


def test_sink_replace_shows_the_new_sequence_after_the_commit(there: Destination) -> None:
    write(there, 1)
    with there.sink.open("drive", {"car": 8}, if_exists=IfExists.REPLACE) as session:
        session.topic("/flag", FLAG, {})
    assert list(there.topics("drive")) == ["/flag"]
    assert there.metadata("drive") == {"car": 8}


def test_sink_append_creates_a_missing_sequence(there: Destination) -> None:
    write(there, 1, if_exists=IfExists.APPEND)
    assert there.sequences() == ["drive"]


def test_sink_append_of_another_type_to_a_topic_is_refused(keeping: Destination) -> None:
    write(keeping, 1)
    with (
        pytest.raises(SinkError, match=r"/gps/fix.*Point.*Flag"),
        keeping.sink.open("drive", {}, if_exists=IfExists.APPEND) as session,
    ):
        session.topic("/gps/fix", FLAG, {})


def test_sink_replace_exchanges_sequences_at_the_commit(there: Destination) -> None:
    write(there, 1)
    with there.sink.open("drive", {"car": 8}, if_exists=IfExists.REPLACE) as session:
        session.topic("/gps/fix", POINT, {}).write(points(2, 3))
        assert there.rows("drive", "/gps/fix").num_rows == 1
    assert there.rows("drive", "/gps/fix").equals(pa.Table.from_batches([points(2, 3)]))
    assert there.metadata("drive") == {"car": 8}


def test_sink_failed_replace_keeps_the_old_sequence(there: Destination) -> None:
    write(there, 1)
    with pytest.raises(CrashError), there.sink.open("drive", {}, if_exists=IfExists.REPLACE) as session:
        session.topic("/gps/fix", POINT, {}).write(points(2, 3))
        raise CrashError
    assert there.rows("drive", "/gps/fix").equals(pa.Table.from_batches([points(1)]))


def test_replace_with_incomplete_session_keeps_stored_sequence(there: Destination) -> None:
    write(there, 1)
    with (
        pytest.raises(SinkError) as raised,
        there.sink.open("drive", {}, if_exists=IfExists.REPLACE) as session,
    ):
        session.topic("/gps/fix", POINT, {}).write(points(2, 3))
        session.note_error("stopped")
    assert raised.value.where == "drive"
    assert there.rows("drive", "/gps/fix").equals(pa.Table.from_batches([points(1)]))
    assert list(there.errors("drive")) == []


def test_replace_with_incomplete_session_creates_missing_sequence(there: Destination) -> None:
    with there.sink.open("drive", {}, if_exists=IfExists.REPLACE) as session:
        session.topic("/gps/fix", POINT, {}).write(points(2, 3))
        session.note_error("stopped")
    assert there.errors("drive") == [(None, "stopped")]


def test_sink_errors_are_stored_with_the_sequence(there: Destination) -> None:
    with there.sink.open("drive", {}) as session:
        session.topic("/gps/fix", POINT, {})
        session.note_error("the run ended early")
        session.note_error("one row was lost", topic="/gps/fix")
    assert sorted(there.errors("drive"), key=str) == [
        ("/gps/fix", "one row was lost"),
        (None, "the run ended early"),
    ]


def test_sink_opening_a_topic_twice_is_refused(there: Destination) -> None:
    with there.sink.open("drive", {}) as session:
        session.topic("/imu", FLAG, {})
        with pytest.raises(SinkError, match="imu"):
            session.topic("imu", FLAG, {})


@pytest.mark.parametrize(
    "batch",
    [
        points(1).rename_columns(["timestamp_ns", "y", "name", "raw"]),
        points(1).select(["timestamp_ns", "x", "name"]),
        pa.RecordBatch.from_arrays(
            [pa.array([None], pa.int64()), *points(1).columns[1:]], schema=points(1).schema
        ),
    ],
    ids=["other name", "missing column", "no time stamp"],
)
def test_sink_batch_of_another_schema_is_refused_and_others_stay(
    there: Destination, batch: pa.RecordBatch
) -> None:
    with there.sink.open("drive", {}) as session:
        writer = session.topic("/gps/fix", POINT, {})
        writer.write(points(1))
        with pytest.raises(SinkError, match="/gps/fix"):
            writer.write(batch)
        writer.write(points(2))
    assert there.rows("drive", "/gps/fix").equals(pa.Table.from_batches([points(1, 2)]))


@pytest.mark.parametrize("name", ["", "a b", "a/b", "a:b", "..", "ünï", "a\nb", 'a"b', "a\x00"])
def test_sink_invalid_sequence_name_is_refused(there: Destination, name: str) -> None:
    with pytest.raises(SinkError), there.sink.open(name, {}):
        pytest.fail("the session opened")


@pytest.mark.parametrize("name", ["", "/", "//a", "/a//b", "/a/", "/a.b", "/../x", "/a b", "/a:b"])
def test_sink_invalid_topic_name_is_refused(there: Destination, name: str) -> None:
    with there.sink.open("drive", {}) as session, pytest.raises(SinkError):
        session.topic(name, FLAG, {})


@pytest.mark.parametrize(
    "name", ["/_hidden", "/~x", "/a@b/c", "/A-1_b", "/a=b", "/a\\b", "/(x)", "/" + "long" * 200]
)
def test_sink_valid_topic_name_is_preserved(there: Destination, name: str) -> None:
    with there.sink.open("drive", {}) as session:
        session.topic(name, POINT, {}).write(points(1))
    assert list(there.topics("drive")) == [name]
    assert there.rows("drive", name).num_rows == 1


@pytest.mark.parametrize(
    "metadata",
    [{"a.b": 1}, {"a": {"b/c": 1}}, {"a": [{"--": 1}]}, {"": 1}, {"a": float("nan")}, {"a": object()}],
)
def test_sink_invalid_metadata_is_refused(there: Destination, metadata: dict[str, Any]) -> None:
    with pytest.raises(SinkError, match="drive"), there.sink.open("drive", metadata):
        pytest.fail("the session opened")
    with there.sink.open("drive", {}) as session, pytest.raises(SinkError, match="/imu"):
        session.topic("/imu", FLAG, metadata)


def amendable(
    there: Destination, if_exists: IfExists = IfExists.FAIL
) -> AbstractContextManager[AmendableSession]:
    sink: Any = there.sink
    session: AbstractContextManager[AmendableSession] = sink.open(
        "drive", {"car": 7}, if_exists=if_exists, amendable=True
    )
    return session


def test_amend_metadata_is_stored_with_the_commit(there: Destination) -> None:
    with amendable(there) as session:
        session.topic("/gps/fix", POINT, {}).write(points(1, 2))
        assert there.sequences() == []
        session.amend({"car": 8, "passed": True})
    assert there.metadata("drive") == {"car": 8, "passed": True}
    assert there.rows("drive", "/gps/fix").num_rows == 2
    assert [topic.rows for topic in session.stored()] == [2]


def test_amend_sequence_stores_content_under_the_other_name_only(there: Destination) -> None:
    for times in ((1, 2), (3, 4, 5)):  # the second session replaces the content of the first one
        with amendable(there) as session:
            session.topic("/gps/fix", POINT, {}).write(points(*times))
            session.amend({"car": 9}, sequence="drive__failed")
    assert there.sequences() == ["drive__failed"]
    assert there.metadata("drive__failed") == {"car": 9}
    assert there.rows("drive__failed", "/gps/fix").column(0).to_pylist() == [3, 4, 5]
    write(there, 1)
    assert there.sequences() == ["drive", "drive__failed"]


def test_amendable_session_exception_leaves_nothing(there: Destination) -> None:
    with pytest.raises(CrashError), amendable(there) as session:
        session.topic("/gps/fix", POINT, {}).write(points(1))
        session.amend({}, sequence="drive__failed")
        raise CrashError
    assert there.sequences() == []
    write(there, 1)


def test_amendable_session_without_changes_behaves_as_any_session(there: Destination) -> None:
    with amendable(there) as session:
        session.topic("/gps/fix", POINT, {}).write(points(1))
    assert (there.sequences(), there.metadata("drive")) == (["drive"], {"car": 7})


def test_amend_during_replace_swaps_the_stored_sequence(keeping: Destination) -> None:
    write(keeping, 1)
    with amendable(keeping, IfExists.REPLACE) as session:
        session.topic("/gps/fix", POINT, {}).write(points(8, 9))
        session.amend({"car": 1})
    assert keeping.rows("drive", "/gps/fix").column(0).to_pylist() == [8, 9]
    assert keeping.metadata("drive") == {"car": 1}
