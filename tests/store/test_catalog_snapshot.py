"""The snapshot of the catalog of a store behind a URL gives the same sequences as the documents."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from operator import attrgetter
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from bucket_service import BucketService, bucket_service
from object_store import CREDENTIALS

from mosaico_ingest.destinations.store import SequenceSummary, Store, StoreSink, documents, object_catalog
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.remote import RemotePath

pytestmark = pytest.mark.slow
Rows = Callable[..., pa.RecordBatch]
NAMES = [f"s{number}" for number in range(6)]


@pytest.fixture(scope="module")
def service() -> Iterator[BucketService]:
    with pytest.MonkeyPatch.context() as patch, bucket_service() as running:
        for name, value in CREDENTIALS.items():
            patch.setenv(name, value)
        yield running


@pytest.fixture
def store(
    service: BucketService, tmp_path: Path, rows: Rows, sample: OntologyType, monkeypatch: pytest.MonkeyPatch
) -> Store:
    """A store of six sequences whose catalog has a snapshot with a tail of at most two documents."""
    monkeypatch.setattr(object_catalog, "MAX_TAIL", 2)
    filled = Store.open(service.url(f"snapshots/{tmp_path.name}"))
    for name in NAMES:
        write(filled, name, rows([1, 2]), sample)
    time.sleep(1.1)  # the server lists times in full seconds
    with monkeypatch.context() as patch:
        patch.setattr(documents, "_SETTLED_NS", 0)
        filled.listing()
    service.requests.clear()
    return filled


def write(store: Store, name: str, rows: pa.RecordBatch, ontology: OntologyType) -> None:
    with StoreSink(store, 1 << 20).open(name, {"name": name}, if_exists=IfExists.REPLACE) as session:
        session.topic("/t", ontology, {}).write(rows)


def read_documents(service: BucketService) -> list[str]:
    """Return the documents that were read since the last call."""
    lines, service.requests[:] = list(service.requests), []
    return sorted(
        {line.rpartition("/")[2] for line in lines if line.startswith("GET") and line.endswith(".json")}
        - {"store.json"}
    )


def snapshot_files(store: Store) -> dict[str, RemotePath]:
    """Return the files of the latest snapshot by name."""
    assert isinstance(store.path, RemotePath)
    (folder,) = documents.Snapshots.listed(store.path).folders
    return {path.name: path for path in folder.iterdir()}


def test_listing_with_snapshot_reads_only_changed_documents(
    store: Store, service: BucketService, rows: Rows, sample: OntologyType
) -> None:
    assert [one.name for one in store.listing().sequences] == NAMES
    assert read_documents(service) == []
    write(store, "s3", rows([1, 2, 3, 4]), sample)
    write(store, "new", rows([1]), sample)
    store.delete_sequence("s0")
    service.requests.clear()
    listing = store.listing()
    assert read_documents(service) == ["new.json", "s3.json"]
    assert {one.name: one.rows for one in listing.sequences} == {
        "new": 1, "s1": 2, "s2": 2, "s3": 4, "s4": 2, "s5": 2,
    }  # fmt: skip
    assert listing.sequences == tuple(map(SequenceSummary.of, store.sequences()))


def test_filters_with_snapshot_equal_complete_entries(store: Store, service: BucketService) -> None:
    assert [one.name for one in store.listing(metadata={"name": "s4"}).sequences] == ["s4"]
    assert read_documents(service) in ([], ["s4.json"])


def test_filtered_listing_reads_each_document_once(
    service: BucketService, tmp_path: Path, rows: Rows, sample: OntologyType
) -> None:
    few = Store.open(service.url(f"filters/{tmp_path.name}"))
    for name in NAMES[:2]:
        write(few, name, rows([1, 2]), sample)
    service.requests.clear()
    assert [one.name for one in few.listing(metadata={"name": "s1"}).sequences] == ["s1"]
    lines = [line for line in service.requests if line.startswith("GET") and "/catalog/" in line]
    assert len(lines) == len(NAMES[:2])


@pytest.mark.parametrize("name", ["index.parquet", "summary.parquet"])
@pytest.mark.parametrize("content", [b"PAR1 damaged", None], ids=["damaged", "missing"])
def test_damaged_snapshot_is_replaced(
    store: Store, service: BucketService, name: str, content: bytes | None
) -> None:
    before = store.listing().sequences
    file = snapshot_files(store)[name]
    file.unlink() if content is None else file.write_bytes(content)
    assert store.listing().sequences == before
    service.requests.clear()
    assert store.listing().sequences == before
    assert read_documents(service) == []


def test_snapshots_written_during_commits_hide_no_change(
    store: Store, rows: Rows, sample: OntologyType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(documents, "_SETTLED_NS", 2 * 10**9)

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


def test_snapshot_of_documents_changed_within_the_resolution_of_times_is_not_reused(
    store: Store, service: BucketService, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(documents, "_SETTLED_NS", 3600 * 10**9)
    snapshot_files(store)["index.parquet"].unlink()
    store.listing()
    service.requests.clear()
    store.listing()
    assert read_documents(service) == []
    store.sequences()
    assert read_documents(service) == [f"{name}.json" for name in NAMES]


class KilledError(BaseException):
    """The process was killed: this request and all later ones were not sent."""


def ends_before_request(action: Callable[[], object], number: int, *, text: str = "") -> bool:
    """Run an action whose process is killed before a request that writes or removes; return whether the action ended.

    Only requests whose path contains the text count.
    """
    sent = itertools.count()

    def guarded(method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            if text in str(arguments[0]) and next(sent) >= number:
                raise KilledError
            return method(*arguments)

        return call

    with pytest.MonkeyPatch.context() as patch:
        for name in ("write_bytes", "unlink", "open_output"):
            patch.setattr(RemotePath, name, guarded(getattr(RemotePath, name)))
        patch.setattr(documents, "_writer", guarded(documents._writer))
        try:
            action()
        except KilledError:
            return False
    return True


def assert_listing_equals_documents(store: Store) -> None:
    """Compare the listing of another process with all documents."""
    another = Store.open(store.path, create=False)
    catalog = another.catalog
    assert isinstance(catalog, object_catalog.ObjectCatalog)
    present = catalog._read_all(list(catalog._listed().values()))
    expected = [catalog._summary(document) for document in present if document is not None]
    assert sorted(another.listing().sequences, key=attrgetter("name")) == sorted(
        expected, key=attrgetter("name")
    )


def write_snapshot(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(object_catalog, "MAX_TAIL", 0)
        Store.open(store.path, create=False).listing()


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Consider all other writers dead, and write no snapshot on the way."""
    monkeypatch.setattr(object_catalog, "MAX_TAIL", 1000)
    monkeypatch.setattr("mosaico_ingest.destinations.store.files._SILENT_S", -1e6)
    monkeypatch.setattr("mosaico_ingest.destinations.store.files.Heartbeat.check", lambda _: None)


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("action", ["replace", "append", "delete", "collect"])
def test_listing_after_killed_writer_equals_documents(
    store: Store, rows: Rows, sample: OntologyType, monkeypatch: pytest.MonkeyPatch, action: str
) -> None:
    sizes = itertools.count(1)

    def change(mode: IfExists) -> None:
        another = Store.open(store.path, create=False)
        with StoreSink(another, 1 << 20).open("s3", {"size": "x" * next(sizes)}, if_exists=mode) as session:
            session.topic("/t", sample, {}).write(rows([1, 2, 3]))

    actions: dict[str, Callable[[], object]] = {
        "replace": lambda: change(IfExists.REPLACE),
        "append": lambda: change(IfExists.APPEND),
        "delete": lambda: Store.open(store.path, create=False).delete_sequence("s3"),
        "collect": lambda: Store.open(store.path, create=False).collect_garbage(),
    }
    for number in itertools.count():
        change(IfExists.REPLACE)
        store.collect_garbage()
        write_snapshot(store, monkeypatch)  # the tail is empty
        if action == "collect":
            assert not ends_before_request(actions["replace"], 0, text="/changes/")
        ended = ends_before_request(actions[action], number)
        assert_listing_equals_documents(store)
        if ended:
            break
    assert number >= 3


@pytest.mark.usefixtures("impatient")
def test_listing_after_killed_writer_of_snapshot_equals_documents(
    store: Store, rows: Rows, sample: OntologyType, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in itertools.count():
        write(store, "s3", rows(list(range(number + 1))), sample)
        write(store, f"new{number}", rows([1]), sample)
        ended = ends_before_request(lambda: write_snapshot(store, monkeypatch), number)
        assert_listing_equals_documents(store)
        if ended:
            break
    assert number >= 5


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("others", [0, 1, 2])
def test_listing_after_concurrent_snapshots_equals_documents(
    store: Store, rows: Rows, sample: OntologyType, monkeypatch: pytest.MonkeyPatch, others: int
) -> None:
    """A writer of a snapshot pauses after it listed the documents; others change sequences, and some publish snapshots."""
    catalog = store.catalog
    assert isinstance(catalog, object_catalog.ObjectCatalog)
    listed = catalog._listed

    def listed_early() -> dict[str, RemotePath]:
        early = listed()
        for other in range(others):
            write(store, "s3", rows(list(range(5 + other))), sample)
            write(store, f"new{other}", rows([1]), sample)
            write_snapshot(store, monkeypatch)
        write(store, "s4", rows([1]), sample)
        return early

    contained = documents.write_snapshot(store.path, catalog._bucket.now_ns, listed_early, catalog._contents)
    assert_listing_equals_documents(store)
    catalog._bucket.remove(contained)
    assert_listing_equals_documents(store)
    write_snapshot(store, monkeypatch)
    assert len(documents.Snapshots.listed(store.path).folders) == 1
    assert_listing_equals_documents(store)
