"""The common behavior of all catalogs of a store: atomic changes and concurrent writers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pytest
from object_store import ObjectStore

from mosaico_ingest.destinations import topic_schema
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.destinations.store.files import NotInStore, new_session_id
from mosaico_ingest.destinations.store.model import NewNote, NewSession, NewTopic, StoreCatalog
from mosaico_ingest.destinations.store.segment import Segment
from mosaico_ingest.errors import SequenceExists, SinkError
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.remote import as_path

POINT = OntologyType("Point", pa.struct([pa.field("x", pa.float64())]))
FLAG = OntologyType("Flag", pa.struct([pa.field("on", pa.bool_())]))


def a_store(request: pytest.FixtureRequest, folder: Path) -> Store:
    if request.param == "sqlite":
        return Store.open(folder / "mosaico")
    objects: ObjectStore = request.getfixturevalue("objects")
    return Store.open(as_path(objects.url(f"records/{folder.name}")))


@pytest.fixture(params=("sqlite", pytest.param("documents", marks=pytest.mark.slow)))
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    return a_store(request, tmp_path)


@pytest.fixture
def records(store: Store) -> StoreCatalog:
    return store.catalog


def alive(_: str) -> bool:
    return True


def dead(_: str) -> bool:
    return False


def written(session: str, *topics: tuple[str, OntologyType], start_ns: int = 0) -> NewSession:
    """Return a session with one segment in each topic; the files themselves do not matter here."""

    def topic(name: str, ontology: OntologyType) -> NewTopic:
        path = f"segments/s{name}/{session}-0000.parquet"
        bounds = (("timestamp_ns", start_ns, start_ns + 9), ("x", -float("inf"), 1.5))
        segment = Segment(as_path(path), 10, 100, start_ns, start_ns + 9, "ab" * 16, bounds)
        return NewTopic(name, ontology, topic_schema(ontology), '{"of": "topic"}', 7, {path: segment})

    return NewSession(session, '{"by": "me"}', 5, tuple(topic(*one) for one in topics), ())


def commit(
    records: StoreCatalog,
    *topics: tuple[str, OntologyType],
    sequence: str = "s",
    if_exists: IfExists = IfExists.FAIL,
    start_ns: int = 0,
) -> tuple[str, list[str]]:
    session = new_session_id()
    claim = records.claim(session, sequence, if_exists, is_live=alive)
    return session, records.commit([(claim, written(session, *topics, start_ns=start_ns))])


def test_committed_sequence_is_read_back_equal(store: Store, records: StoreCatalog) -> None:
    session, replaced = commit(records, ("/a", POINT), ("/b", FLAG))
    assert replaced == []
    assert records.names() == ["s"]
    info = records.sequence("s")
    assert info is not None
    assert info.metadata == {"by": "me"}
    assert [(one.id, one.metadata) for one in info.sessions] == [(session, {"by": "me"})]
    assert [(one.name, one.ontology, one.schema) for one in info.topics] == [
        ("/a", POINT, topic_schema(POINT)),
        ("/b", FLAG, topic_schema(FLAG)),
    ]
    (segment,) = info.topics[0].segments
    assert (segment.rows, segment.stored_bytes, segment.start_ns, segment.end_ns) == (10, 100, 0, 9)
    assert segment.checksum == "ab" * 16
    assert segment.path == store.path / f"segments/s/a/{session}-0000.parquet"
    assert records.bounds(info.topics[0], ["x"]) == {segment.path: {"x": (-float("inf"), 1.5)}}
    assert records.sequences() == (info,)
    assert records.sequence("t") is None


def test_claim_is_invisible_before_its_commit(records: StoreCatalog) -> None:
    records.claim(new_session_id(), "s", IfExists.FAIL, is_live=alive)
    assert records.names() == []


@pytest.mark.parametrize("policy", [IfExists.FAIL, IfExists.SKIP])
def test_existing_name_is_refused(records: StoreCatalog, policy: IfExists) -> None:
    commit(records, ("/a", POINT))
    with pytest.raises(SequenceExists, match="the sequence already exists"):
        records.claim(new_session_id(), "s", policy, is_live=alive)


def test_second_writer_is_refused_while_the_first_is_alive(records: StoreCatalog) -> None:
    first = new_session_id()
    records.claim(first, "s", IfExists.FAIL, is_live=alive)
    with pytest.raises(SequenceExists, match="another run is writing"):
        records.claim(new_session_id(), "s", IfExists.REPLACE, is_live=alive)
    records.claim(new_session_id(), "t", IfExists.FAIL, is_live=alive)
    records.release(first, "s")
    records.claim(new_session_id(), "s", IfExists.FAIL, is_live=alive)


def test_claim_of_dead_writer_does_not_block(records: StoreCatalog) -> None:
    first = new_session_id()
    claim = records.claim(first, "s", IfExists.FAIL, is_live=alive)
    second = new_session_id()
    other = records.claim(second, "s", IfExists.FAIL, is_live=dead)
    records.commit([(other, written(second, ("/a", POINT)))])
    with pytest.raises(SinkError):
        records.commit([(claim, written(first, ("/b", POINT)))])
    info = records.sequence("s")
    assert info is not None
    assert [topic.name for topic in info.topics] == ["/a"]


def test_append_adds_to_existing_sequence(records: StoreCatalog) -> None:
    first, _ = commit(records, ("/a", POINT))
    second, replaced = commit(records, ("/a", POINT), ("/b", FLAG), if_exists=IfExists.APPEND, start_ns=100)
    assert replaced == []
    info = records.sequence("s")
    assert info is not None
    assert [one.id for one in info.sessions] == sorted([first, second])
    assert [one.session for one in info.topics[0].segments] == [first, second]
    assert info.topics[1].session == second


def test_two_writers_can_append_concurrently(records: StoreCatalog) -> None:
    commit(records, ("/a", POINT))
    sessions = [new_session_id() for _ in range(2)]
    claims = [records.claim(one, "s", IfExists.APPEND, is_live=alive) for one in sessions]
    for session, claim in zip(sessions, claims, strict=True):
        records.commit([(claim, written(session, ("/a", POINT)))])
    info = records.sequence("s")
    assert info is not None
    assert len(info.topics[0].segments) == 3


def test_append_of_another_type_to_a_topic_is_refused(records: StoreCatalog) -> None:
    commit(records, ("/a", POINT))
    with pytest.raises(SinkError, match="the topic holds Point"):
        commit(records, ("/a", FLAG), if_exists=IfExists.APPEND)
    info = records.sequence("s")
    assert info is not None
    assert len(info.sessions) == 1


def test_replace_exchanges_the_sequence(records: StoreCatalog) -> None:
    first, _ = commit(records, ("/a", POINT), ("/b", FLAG))
    second, replaced = commit(records, ("/c", FLAG), if_exists=IfExists.REPLACE)
    assert sorted(replaced) == [f"segments/s/{name}/{first}-0000.parquet" for name in "ab"]
    info = records.sequence("s")
    assert info is not None
    assert [topic.name for topic in info.topics] == ["/c"]
    assert [one.id for one in info.sessions] == [second]


def test_replace_fails_if_the_sequence_changed_meanwhile(records: StoreCatalog) -> None:
    commit(records, ("/a", POINT))
    session = new_session_id()
    claim = records.claim(session, "s", IfExists.REPLACE, is_live=alive)
    others = records.claim(appended := new_session_id(), "s", IfExists.APPEND, is_live=dead)
    try:
        records.commit([(others, written(appended, ("/a", POINT)))])
    except SinkError:
        return  # the claim alone keeps others away
    with pytest.raises(SinkError, match="changed the sequence"):
        records.commit([(claim, written(session, ("/c", FLAG)))])


def test_notes_are_added_and_deleted(records: StoreCatalog) -> None:
    records.create("s", '{"a": 1}')
    records.note("s", NewNote(None, "of all", 1))
    records.note("s", NewNote("/a", "of one", 2))
    info = records.sequence("s")
    assert info is not None
    assert info.metadata == {"a": 1}
    assert [(one.topic, one.message) for one in info.notes] == [(None, "of all"), ("/a", "of one")]
    records.delete_notes("s", None)
    info = records.sequence("s")
    assert info is not None
    assert [one.message for one in info.notes] == ["of one"]
    with pytest.raises(SequenceExists):
        records.create("s", "{}")


def test_removing_a_sequence_removes_its_records(records: StoreCatalog) -> None:
    first, _ = commit(records, ("/a", POINT), ("/b", FLAG))
    second, _ = commit(records, ("/a", POINT), ("/c", FLAG), if_exists=IfExists.APPEND)
    records.note("s", NewNote("/b", "gone with it", 1))
    assert records.delete_topic("s", "/b") == [f"segments/s/b/{first}-0000.parquet"]
    assert sorted(records.delete_session("s", second)) == [
        f"segments/s/{name}/{second}-0000.parquet" for name in "ac"
    ]
    info = records.sequence("s")
    assert info is not None
    assert ([topic.name for topic in info.topics], info.notes) == (["/a"], ())
    assert records.delete_sequence("s") == [f"segments/s/a/{first}-0000.parquet"]
    assert records.names() == []


@pytest.mark.parametrize(
    "remove",
    [
        lambda records: records.delete_sequence("none"),
        lambda records: records.delete_topic("s", "/none"),
        lambda records: records.delete_session("s", "none"),
        lambda records: records.delete_notes("none", None),
        lambda records: records.note("none", NewNote(None, "x", 1)),
    ],
)
def test_removing_a_missing_sequence_is_an_error(
    records: StoreCatalog, remove: Callable[[StoreCatalog], object]
) -> None:
    commit(records, ("/a", POINT))
    with pytest.raises(NotInStore, match="there is no"):
        remove(records)


def test_garbage_collection_removes_dead_claims_and_lists_every_path(records: StoreCatalog) -> None:
    session, _ = commit(records, ("/a", POINT))
    crashed = new_session_id()
    records.claim(crashed, "t", IfExists.FAIL, is_live=alive)
    assert records.forget({crashed}) == {f"segments/s/a/{session}-0000.parquet"}
    with pytest.raises(SequenceExists, match="another run"):
        records.claim(new_session_id(), "t", IfExists.FAIL, is_live=alive)
    records.forget(())
    records.claim(new_session_id(), "t", IfExists.FAIL, is_live=alive)


def test_names_of_any_length_and_spelling_are_preserved(records: StoreCatalog) -> None:
    names = sorted(["a-b_c", "with(brackets)", "per,cent~", "x" * 300, "x" * 300 + "y"])
    for name in names:
        records.create(name, "{}")
    assert records.names() == names
    assert [info.name for info in records.sequences()] == names
