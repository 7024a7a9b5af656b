"""The catalog stays open between the recordings of a batch and is closed afterwards."""

from __future__ import annotations

import shutil
import sqlite3
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest

from mosaico_ingest.destinations import keep_destinations_open
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.destinations.store import sqlite as connections
from mosaico_ingest.errors import SequenceExists
from mosaico_ingest.executors import InProcess
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.pipeline.task import Task

DRIVE = Path(__file__).resolve().parents[2] / "configs" / "quickstart" / "drive.mcap"


def task(folder: Path, name: str) -> Task:
    config = ROSInjectionConfig(file_path=DRIVE, sequence_name=name, topics=["/imu"], store=folder / "store")
    return Task(config.job)


@pytest.fixture
def groups_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mosaico_ingest.destinations.store.destination._MAX_COMMITS", 1)


@pytest.mark.usefixtures("groups_of_one")
def test_in_process_executor_keeps_catalog_open_between_groups(tmp_path: Path) -> None:
    log = tmp_path / "store/catalog.sqlite-wal"
    there = [log.exists() for _ in InProcess().map([task(tmp_path, name) for name in "abc"], lambda *_: None)]
    assert there == [False, True, True]
    assert not log.exists()
    assert Store.open(tmp_path / "store", create=False).names() == ("a", "b", "c")


def test_keep_open_store_removed_between_runs_is_created_again(tmp_path: Path) -> None:
    """Closing the old catalog must not delete the files of the new one."""
    with keep_destinations_open() as keep_open:
        for name in "ab":
            list(InProcess().map([task(tmp_path, name)], lambda *_: None))
            keep_open(task(tmp_path, name).job.destination)
            if name == "a":
                shutil.rmtree(tmp_path / "store")
        kept = Store.open(tmp_path / "store", create=False).catalog.keep_open()
    assert (tmp_path / "store/catalog.sqlite-wal").exists()
    kept.close()
    assert Store.open(tmp_path / "store", create=False).names() == ("b",)


def test_keep_open_without_store_creates_nothing(tmp_path: Path) -> None:
    with keep_destinations_open() as keep_open:
        keep_open(task(tmp_path, "a").job.destination)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("groups_of_one")
def test_batch_opens_few_connections_to_catalog(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths: list[Path] = []

    def connect(path: Path, query: str) -> sqlite3.Connection:
        paths.append(path)
        return original(path, query)

    original = connections.connect
    monkeypatch.setattr(connections, "connect", connect)
    counts = [len(paths) for _ in InProcess().map([task(tmp_path, name) for name in "abcd"], lambda *_: None)]
    assert counts[1:] == [counts[1]] * 3
    assert Store.open(tmp_path / "store", create=False).names() == ("a", "b", "c", "d")


def test_catalog_closed_by_one_of_two_handles_stays_open(tmp_path: Path) -> None:
    catalog = Store.open(tmp_path / "store").catalog
    log = tmp_path / "store/catalog.sqlite-wal"
    first, second = catalog.keep_open(), catalog.keep_open()
    catalog.create("a", "{}")
    first.close()
    first.close()
    assert log.exists()
    assert catalog.names() == ["a"]
    second.close()
    assert not log.exists()
    assert connections.find_open(tmp_path / "store/catalog.sqlite") is None


def test_open_catalog_after_failed_call_is_usable(tmp_path: Path) -> None:
    catalog = Store.open(tmp_path / "store").catalog
    with closing(catalog.keep_open()):
        catalog.create("a", "{}")
        with pytest.raises(SequenceExists):
            catalog.create("a", "{}")
        catalog.create("b", "{}")
    assert catalog.names() == ["a", "b"]


def test_threads_use_separate_connections_of_open_catalog(tmp_path: Path) -> None:
    catalog = Store.open(tmp_path / "store").catalog
    with closing(catalog.keep_open()), ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda number: catalog.create(f"s{number:02}", "{}"), range(40)))
    assert catalog.names() == [f"s{number:02}" for number in range(40)]
