"""The snapshot of the catalog of a store behind a URL gives the same sequences as the documents."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pyarrow as pa
import pytest
from object_store import ObjectStore

from mosaico_ingest.destinations.store import SequenceSummary, Store, StoreSink, object_catalog
from mosaico_ingest.destinations.store import documents as snapshot
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.remote import RemotePath, as_path

pytestmark = pytest.mark.slow
Rows = Callable[..., pa.RecordBatch]
NAMES = [f"s{number}" for number in range(6)]


@pytest.fixture
def store(
    objects: ObjectStore, tmp_path: Path, rows: Rows, sample: OntologyType, monkeypatch: pytest.MonkeyPatch
) -> Store:
    """A store of six sequences whose catalog has a snapshot with a tail of at most two documents."""
    monkeypatch.setattr(object_catalog, "MAX_TAIL", 2)
    monkeypatch.setattr(snapshot, "_SETTLED_NS", 0)
    filled = Store.open(objects.url(f"snapshots/{tmp_path.name}"))
    for name in NAMES:
        write(filled, name, rows([1, 2]), sample)
    time.sleep(1.1)  # the server lists times in full seconds
    filled.listing()
    objects.counts()
    return filled


def write(store: Store, name: str, rows: pa.RecordBatch, ontology: OntologyType) -> None:
    with StoreSink(store, 1 << 20).open(name, {"name": name}, if_exists=IfExists.REPLACE) as session:
        session.topic("/t", ontology, {}).write(rows)


def read_documents(objects: ObjectStore) -> list[str]:
    lines = objects.counts().requests
    return sorted(
        {
            line.partition("?")[0].rpartition("/")[2]
            for line in lines
            if line.startswith("GET") and ".json" in line
        }
    )


def snapshot_file(objects: ObjectStore, tmp_path: Path) -> RemotePath:
    path = as_path(objects.url(f"snapshots/{tmp_path.name}/snapshots/catalog-1.parquet"))
    assert isinstance(path, RemotePath)
    return path


def test_listing_with_snapshot_reads_only_changed_documents(
    store: Store, objects: ObjectStore, rows: Rows, sample: OntologyType
) -> None:
    assert [one.name for one in store.listing().sequences] == NAMES
    assert read_documents(objects) == []
    write(store, "s3", rows([1, 2, 3, 4]), sample)
    write(store, "new", rows([1]), sample)
    store.delete_sequence("s0")
    objects.counts()
    listing = store.listing()
    assert read_documents(objects) == ["new.json", "s3.json"]
    assert {one.name: one.rows for one in listing.sequences} == {
        "new": 1, "s1": 2, "s2": 2, "s3": 4, "s4": 2, "s5": 2,
    }  # fmt: skip
    assert listing.sequences == tuple(map(SequenceSummary.of, store.sequences()))


def test_filters_with_snapshot_equal_complete_entries(store: Store, objects: ObjectStore) -> None:
    assert [one.name for one in store.listing(metadata={"name": "s4"}).sequences] == ["s4"]
    assert read_documents(objects) in ([], ["s4.json"])


def test_filtered_listing_reads_each_document_once(
    objects: ObjectStore, tmp_path: Path, rows: Rows, sample: OntologyType
) -> None:
    few = Store.open(objects.url(f"filters/{tmp_path.name}"))
    for name in NAMES[:2]:
        write(few, name, rows([1, 2]), sample)
    objects.counts()
    assert [one.name for one in few.listing(metadata={"name": "s1"}).sequences] == ["s1"]
    lines = [line for line in objects.counts().requests if line.startswith("GET") and ".json" in line]
    assert len(lines) == len(NAMES[:2])


def test_damaged_snapshot_is_replaced(store: Store, objects: ObjectStore, tmp_path: Path) -> None:
    before = store.listing().sequences
    snapshot_file(objects, tmp_path).write_bytes(b"PAR1 damaged")
    assert store.listing().sequences == before
    objects.counts()
    assert store.listing().sequences == before
    assert read_documents(objects) == []


def test_snapshots_written_during_commits_hide_no_change(
    store: Store, rows: Rows, sample: OntologyType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(snapshot, "_SETTLED_NS", 2 * 10**9)

    def change(number: int) -> None:
        write(store, NAMES[number % 6], rows(list(range(number + 1))), sample)

    with ThreadPoolExecutor(4) as pool:
        listings = [pool.submit(store.listing) for _ in range(4)]
        for number in range(6, 12):
            pool.submit(change, number).result()
            listings.append(pool.submit(store.listing))
        for each in listings:
            assert len(each.result().sequences) == 6
    assert [one.rows for one in store.listing().sequences] == list(range(7, 13))


def test_document_changed_within_the_resolution_of_times_is_not_in_the_snapshot(
    store: Store, objects: ObjectStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(snapshot, "_SETTLED_NS", 3600 * 10**9)
    snapshot_file(objects, tmp_path).unlink()
    store.listing()
    objects.counts()
    store.listing()
    assert read_documents(objects) == [f"{name}.json" for name in NAMES]
