"""The catalog stays open between the recordings of a batch and is closed afterwards."""

from __future__ import annotations

import shutil
from pathlib import Path

from mosaico_ingest.destinations.registry import keep_destinations_open
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.executors.base import InProcess
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.pipeline.task import Task

DRIVE = Path(__file__).resolve().parents[2] / "configs" / "quickstart" / "drive.mcap"


def task(folder: Path, name: str) -> Task:
    config = ROSInjectionConfig(file_path=DRIVE, sequence_name=name, topics=["/imu"], store=folder / "store")
    return Task(config.job)


def test_in_process_executor_keeps_catalog_open_between_recordings(tmp_path: Path) -> None:
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
