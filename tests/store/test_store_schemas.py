"""Topics with equal columns share one schema in the catalog, and catalogs of format 1 are read and converted."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import pyarrow as pa
import pytest
from store_formats import make_format_1

from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.destinations.store.catalog import FORMAT
from mosaico_ingest.ontology.registry import OntologyType, ontology_type

Rows = Callable[..., pa.RecordBatch]


def query(store: Store, statement: str) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(store.layout.root / "catalog.sqlite")) as db:
        return db.execute(statement).fetchall()


def fill(sink: StoreSink, rows: Rows, sample: OntologyType, names: str) -> None:
    for name in names:
        with sink.open(name, {}) as session:
            session.topic("/t", sample, {}).write(rows([1]))
            session.topic("/u", sample, {}).write(rows([2]))
            session.topic("/imu", ontology_type("IMU"), {})


@pytest.fixture
def old(store: Store, sink: StoreSink, rows: Rows, sample: OntologyType) -> Store:
    """A store of format 1 with two sequences."""
    fill(sink, rows, sample, "ab")
    make_format_1(store.layout.root)
    references = query(store, "SELECT sql FROM sqlite_master WHERE name = 'segments'")
    assert "current" not in str(references)
    return store


def test_equal_schemas_are_stored_once(
    store: Store, sink: StoreSink, rows: Rows, sample: OntologyType
) -> None:
    fill(sink, rows, sample, "abc")
    assert query(store, "SELECT count(*) FROM topics") == [(9,)]
    assert query(store, "SELECT count(*) FROM schemas") == [(2,)]
    assert [topic.ontology.tag for topic in store.sequence("b").topics] == [
        "IMU",
        *[sample.tag] * 2,
    ]


def test_collect_garbage_removes_schemas_without_topic(
    store: Store, sink: StoreSink, rows: Rows, sample: OntologyType
) -> None:
    fill(sink, rows, sample, "ab")
    for name in "ab":
        store.delete_topic(name, "/imu")
    store.collect_garbage()
    assert query(store, "SELECT count(*) FROM schemas") == [(1,)]
    assert store.topic("a", "/t").rows == 1


def test_store_of_format_1_is_read_without_change(old: Store) -> None:
    reader = Store.open(old.layout.root, create=False)
    assert [topic.name for topic in reader.sequence("a").topics] == ["/imu", "/t", "/u"]
    assert reader.scan("a", "/u").read_all().num_rows == 1
    assert query(old, "PRAGMA user_version") == [(1,)]


def test_store_of_format_1_opened_for_writing_is_converted(
    old: Store, rows: Rows, sample: OntologyType
) -> None:
    before = Store.open(old.layout.root, create=False).sequences()
    converted = Store.open(old.layout.root)
    assert query(old, "PRAGMA user_version") == [(FORMAT,)]
    assert query(old, "SELECT count(*) FROM schemas") == [(2,)]
    assert converted.sequences() == before
    fill(StoreSink(converted), rows, sample, "c")
    with StoreSink(converted).open("d", {}) as session:
        session.topic("/t", sample, {}).write(rows([3]))
    assert query(old, "SELECT count(*) FROM schemas") == [(2,)]
    assert converted.names() == ("a", "b", "c", "d")
    assert query(old, "PRAGMA integrity_check") == [("ok",)]
    assert query(old, "PRAGMA foreign_key_check") == []


def test_store_of_format_1_opened_by_many_writers_is_converted_once(old: Store) -> None:
    with ThreadPoolExecutor(8) as pool:
        stores = list(pool.map(Store.open, [old.layout.root] * 8))
    assert {store.names() for store in stores} == {("a", "b")}
    assert query(old, "SELECT count(*) FROM schemas") == [(2,)]
