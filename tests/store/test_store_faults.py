"""Faults of disks, files and locks under a store: each raises one error and leaves no partial sequence."""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from disks import MEBIBYTE, read_only, small_disk

from mosaico_ingest.destinations.store import Store, StoreSink, catalog
from mosaico_ingest.destinations.store.catalog import FORMAT, Catalog
from mosaico_ingest.destinations.store.files import Lease, is_live, translate_errors
from mosaico_ingest.destinations.store.segment import SegmentWriter
from mosaico_ingest.errors import SinkError, SinkUnavailable
from mosaico_ingest.ontology.registry import OntologyType

Rows = Callable[..., pa.RecordBatch]


def test_open_missing_store_without_create_raises_and_creates_nothing(tmp_path: Path) -> None:
    with pytest.raises(SinkError, match="there is no store here"):
        Store.open(tmp_path / "nowhere", create=False)
    assert list(tmp_path.iterdir()) == []


def test_open_store_of_newer_format_raises_and_changes_nothing(store: Store) -> None:
    with closing(sqlite3.connect(store.layout.catalog)) as db:
        db.execute(f"PRAGMA user_version = {FORMAT + 1}")
        db.execute("ALTER TABLE segments DROP COLUMN checksum")
        before = db.execute("SELECT sql FROM sqlite_master").fetchall()
        with pytest.raises(SinkError, match=f"format {FORMAT + 1}.*upgrade"):
            Store.open(store.path)
        assert db.execute("SELECT sql FROM sqlite_master").fetchall() == before


def test_open_empty_catalog_without_create_raises(tmp_path: Path) -> None:
    (tmp_path / "catalog.sqlite").touch()
    with pytest.raises(SinkError, match="there is no store here"):
        Store.open(tmp_path, create=False)


def test_open_locked_new_catalog_waits_for_lock(tmp_path: Path) -> None:
    """SQLite does not wait for a lock when it switches to the write-ahead log."""
    connection = sqlite3.connect(tmp_path / "catalog.sqlite", isolation_level=None, check_same_thread=False)
    with closing(connection):
        connection.execute("BEGIN EXCLUSIVE")
        timer = threading.Timer(0.3, connection.rollback)
        timer.start()
        assert Store.open(tmp_path).names() == ()
        timer.join()
        assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)


def open_catalogs(store: Store) -> int:
    """Return the number of open file descriptors of the catalog in this process."""
    catalog = store.layout.catalog.resolve()
    return sum(link.exists() and link.resolve() == catalog for link in Path("/proc/self/fd").iterdir())


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="open files are listed in /proc")
def test_session_keeps_catalog_open_and_allows_other_sessions(
    sink: StoreSink, store: Store, rows: Rows, sample: OntologyType
) -> None:
    log = store.layout.catalog.with_name("catalog.sqlite-wal")
    with sink.open("s", {}) as session:
        session.topic("/t", sample, {}).write(rows([1]))
        assert open_catalogs(store)
        with sink.open("other", {}) as other:
            other.topic("/t", sample, {}).write(rows([1]))
        assert log.stat().st_size, "closing a session does not checkpoint while another is open"
    assert open_catalogs(store) == 0
    assert not log.exists() or not log.stat().st_size, "closing the last session checkpoints"
    with pytest.raises(SinkError, match="exists"), sink.open("s", {}):
        pytest.fail("the session opened")
    assert open_catalogs(store) == 0


def test_session_with_unknown_commit_result_keeps_files(
    sink: StoreSink, store: Store, rows: Rows, sample: OntologyType, monkeypatch: pytest.MonkeyPatch
) -> None:
    entered = Catalog.commit

    def commit(catalog: Catalog, *session: Any) -> None:
        entered(catalog, *session)
        raise SinkError("the catalog refuses: disk I/O error")

    def unreadable(*_: object) -> None:
        raise SinkError("the catalog refuses: disk I/O error")

    with monkeypatch.context() as patched, pytest.raises(SinkError, match="disk I/O"):
        patched.setattr(Catalog, "commit", commit)
        patched.setattr(Catalog, "sequence", unreadable)
        with sink.open("s", {}) as session:
            session.topic("/t", sample, {}).write(rows([1]))
    assert store.scan("s", "/t").read_all().num_rows == 1


def test_open_foreign_file_at_catalog_path_raises(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "catalog.sqlite")) as db:
        db.execute("CREATE TABLE theirs (x)")
    with pytest.raises(SinkError, match="not the catalog of a store"):
        Store.open(tmp_path)
    (tmp_path / "catalog.sqlite").write_bytes(b"certainly not a database, but long enough to be one" * 20)
    with pytest.raises(SinkError, match="not a database"):
        Store.open(tmp_path)


def test_open_file_at_store_path_raises_with_path(tmp_path: Path) -> None:
    (tmp_path / "mosaico").write_text("a file")
    with pytest.raises(SinkError, match="mosaico"):
        Store.open(tmp_path / "mosaico")


def test_open_empty_catalog_initializes_it(tmp_path: Path) -> None:
    (tmp_path / "catalog.sqlite").touch()
    assert Store.open(tmp_path).sequences() == ()


def _open(path: Path) -> int:
    return len(Store.open(path).sequences())


@pytest.mark.slow
def test_open_new_store_in_many_processes_succeeds(tmp_path: Path) -> None:
    with ProcessPoolExecutor(8, mp_context=get_context("spawn")) as pool:
        for attempt in range(5):
            assert list(pool.map(_open, [tmp_path / str(attempt)] * 16)) == [0] * 16


def test_session_with_store_deleted_fails(
    sink: StoreSink, store: Store, rows: Rows, sample: OntologyType
) -> None:
    with pytest.raises(SinkError, match=r"mosaico.*No such file"), sink.open("s", {}) as session:
        session.topic("/t", sample, {}).write(rows([1]))
        shutil.rmtree(store.path)
    assert not store.path.exists() or list(store.path.rglob("*.parquet")) == []


def test_session_with_catalog_deleted_fails(
    sink: StoreSink, store: Store, rows: Rows, sample: OntologyType
) -> None:
    with pytest.raises(SinkError, match=r"catalog"), sink.open("s", {}) as session:
        session.topic("/t", sample, {}).write(rows([1]))
        store.layout.catalog.unlink()
    Store.open(store.path).collect_garbage(grace_s=0)
    assert list(store.layout.segment_files()) == []


def test_scan_and_stored_with_deleted_segment_raise_with_its_path(
    sink: StoreSink, store: Store, rows: Rows, sample: OntologyType
) -> None:
    with sink.open("s", {}) as session:
        session.topic("/t", sample, {}).write(rows([1]))
    reader = store.scan("s", "/t")
    store.paths("s", "/t")[0].unlink()
    with pytest.raises(SinkError, match=r"\.parquet"):
        reader.read_all()
    with pytest.raises(SinkError, match=r"\.parquet"):
        session.stored()


def test_session_in_read_only_store_raises(store: Store) -> None:
    with read_only(store.path):
        assert Store.open(store.path, create=False).sequences() == ()
        with pytest.raises(SinkError, match=r"Read-only|write to"), StoreSink(store).open("s", {}):
            pytest.fail("the session opened")


@pytest.fixture
def little_space(tmp_path: Path) -> Iterator[Path]:
    """A file system of 2 MiB."""
    with small_disk(tmp_path / "small", 2 * MEBIBYTE) as folder:
        yield folder


def test_session_on_full_disk_fails_and_leaves_no_files(
    little_space: Path, sample: OntologyType, rows: Rows
) -> None:
    store = Store.open(little_space / "mosaico")
    noise = OntologyType("Noise", pa.struct([pa.field("raw", pa.binary())]))
    with (
        pytest.raises(SinkError, match=r"No space left.*free some space"),
        StoreSink(store).open("s", {}) as session,
    ):
        topic = session.topic("/t", noise, {})
        blobs = pa.array([os.urandom(4_000_000)])
        topic.write(pa.RecordBatch.from_arrays([pa.array([1]), blobs], schema=topic.schema))
    assert store.sequences() == ()
    assert list(store.path.rglob("*.parquet")) == []
    with StoreSink(store).open("s", {}) as session:
        session.topic("/t", sample, {}).write(rows([1]))
    assert store.sequence("s").rows == 1


def test_session_with_failed_topic_write_is_not_committed(
    sink: StoreSink, store: Store, rows: Rows, sample: OntologyType, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with pytest.raises(SinkError, match="earlier write of the topic failed"), sink.open("s", {}) as session:
        topic = session.topic("/t", sample, {})
        topic.write(rows([1]))
        with monkeypatch.context() as patched:
            patched.setattr(SegmentWriter, "append", fail)
            with pytest.raises(SinkError, match="Input/output error"):
                topic.flush()
        with pytest.raises(SinkError, match="earlier write of the topic failed"):
            topic.write(rows([2]))
    assert store.sequences() == ()
    assert list(store.path.rglob("*.parquet")) == []


FULL = """
import signal, resource, sys
from mosaico_ingest.errors import SinkError
sys.path.insert(0, sys.argv[2])
from writer_process import main
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
from mosaico_ingest.destinations.store import Store
Store.open(sys.argv[1])
resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192))
try:
    main(sys.argv[1], "s", "fail", 1)
except SinkError as err:
    print(str(err).count("\\n"), err)
"""


@pytest.mark.skipif(find_spec("resource") is None, reason="limits file sizes with the module resource")
def test_session_beyond_file_size_limit_fails_and_leaves_no_files(store: Store) -> None:
    result = subprocess.run(  # noqa: S603 - this interpreter, our own script
        [sys.executable, "-c", FULL, str(store.path), str(Path(__file__).parent)],
        capture_output=True,
        text=True,
        check=True,
    )
    last = result.stdout.splitlines()[-1]
    assert last.startswith("0 ")
    assert "done" not in result.stdout
    assert store.sequences() == ()
    assert list(store.path.rglob("*.parquet")) == []


def test_explained_locked_database_raises_sink_unavailable() -> None:
    with pytest.raises(SinkUnavailable, match="busy"), translate_errors("store"):
        raise sqlite3.OperationalError("database is locked")


def test_lease_is_live_until_released(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    assert not is_live(path)
    lease = Lease(path)
    assert is_live(path)
    lease.release()
    assert not is_live(path)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_store_opened_by_many_processes_is_never_seen_uninitialized(tmp_path: Path) -> None:
    """A process that finds the catalog while another one creates it must be able to open it."""
    context = get_context("fork")
    for round_number in range(8):
        folder = tmp_path / str(round_number)
        start, results = context.Event(), context.Queue()
        workers = [
            context.Process(target=_open_when_visible, args=(folder, start, results, number % 2 == 0))
            for number in range(6)
        ]
        for worker in workers:
            worker.start()
        start.set()
        outcomes = [results.get(timeout=60) for _ in workers]
        for worker in workers:
            worker.join()
        assert outcomes == [None] * len(workers)
        assert not list(folder.glob(".catalog*"))


def test_catalog_under_creation_has_no_name_until_it_is_initialized(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    visible: list[bool] = []
    use_wal = catalog._use_wal

    def observe(db: sqlite3.Connection) -> None:
        visible.append((tmp_path / "catalog.sqlite").exists())
        use_wal(db)

    monkeypatch.setattr(catalog, "_use_wal", observe)
    Store.open(tmp_path)
    assert visible == [False, True], "the draft, then the catalog"
    assert Store.find(tmp_path) is not None


def _open_when_visible(folder: Path, start: Any, results: Any, create: bool) -> None:  # noqa: FBT001 - passed by a process
    try:
        start.wait()
        if create:
            Store.open(folder)
        else:
            while Store.find(folder) is None:
                pass
    except Exception as error:  # noqa: BLE001 - reported to the parent
        results.put(repr(error))
    else:
        results.put(None)
