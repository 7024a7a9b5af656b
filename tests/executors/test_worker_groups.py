"""Groups of recordings in worker processes: their sizes, and a process that dies or a job that cannot be sent."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from mosaico_ingest import executors as groups
from mosaico_ingest.executors import Batch
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.report.events import ignore_batch

DRIVE = Path(__file__).resolve().parents[2] / "configs" / "quickstart" / "drive.mcap"


def tasks(folder: Path, names: str) -> Iterator[Task]:
    yield from (Task(ROSInjectionConfig(DRIVE, name, store=folder / "store").job) for name in names)


def test_batch_groups_small_recordings(tmp_path: Path) -> None:
    batch = Batch(tasks(tmp_path, "abcde"), ignore_batch)
    assert [batch.take_group(size) for size in (1, 3, 3, 3)] == [[0], [1, 2, 3], [4], []]


def test_batch_large_recording_is_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(groups, "SMALL_BYTES", 0)
    batch = Batch(tasks(tmp_path, "ab"), ignore_batch)
    assert [batch.take_group(2), batch.take_group(2), batch.take_group(2)] == [[0], [1], []]


def test_batch_recordings_of_a_lost_group_are_started_one_by_one_and_first(tmp_path: Path) -> None:
    batch = Batch(tasks(tmp_path, "abcd"), ignore_batch)
    group = batch.take_group(3)
    for position in group:
        batch.start(position)
    batch.retry(group)
    assert [batch.take_group(3) for _ in range(4)] == [[0], [1], [2], [3]]
