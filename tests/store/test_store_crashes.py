"""Writers killed at random moments leave either the old or the new sequence."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.destinations.store import files as layout
from mosaico_ingest.destinations.store.catalog import Catalog
from mosaico_ingest.errors import SequenceExists, SinkError
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.ontology.registry import OntologyType

WRITER = Path(__file__).with_name("writer_process.py")
Rows = Callable[..., pa.RecordBatch]


@contextmanager
def writer(
    store: Store, *sequences: str, if_exists: str = "fail", source: int = 1
) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, str(WRITER), str(store.path), ",".join(sequences), if_exists, str(source)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:  # noqa: S603 - this interpreter, our own script
        try:
            yield process
        finally:
            process.kill()
            process.wait()


def sources(store: Store, sequence: str) -> set[int]:
    """Check that the sequence is complete, and return the numbers of the writers of its rows."""
    info = store.sequence(sequence)
    assert [topic.name for topic in info.topics] == ["/t0", "/t1", "/t2", "/t3"]
    actual: set[int] = set()
    for topic in info.topics:
        table = store.scan(sequence, topic.name).read_all()
        assert table["timestamp_ns"].to_pylist() == list(range(2000))
        actual |= set(table["source"].to_pylist())
    return actual


def assert_tidy(store: Store) -> None:
    """Check that no staged files remain, and that the segment files equal those in the catalog."""
    store.collect_garbage(grace_s=0)
    known = {
        path
        for info in store.sequences()
        for topic in info.topics
        for path in store.paths(info.name, topic.name)
    }
    assert set(store.layout.segment_files()) == known
    assert store.layout.open_sessions() == []


def kill_and_look(store: Store, moments: random.Random, rounds: int) -> None:
    """Kill processes that replace two sequences in one group; both are always of the same process."""
    current = 0
    with writer(store, "drive", "next", if_exists="replace", source=current) as first:
        assert first.wait(30) == 0
    for source in range(1, rounds + 1):
        with writer(store, "drive", "next", if_exists="replace", source=source) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            time.sleep(moments.random() * 0.15)
            process.kill()
            process.wait()
        (survivor,) = sources(store, "drive") | sources(store, "next")
        assert survivor in {current, source}
        current = survivor
    assert_tidy(store)
    assert sources(store, "drive") == {current}


def test_replace_by_killed_writer_leaves_old_or_new_sequences(store: Store) -> None:
    kill_and_look(store, random.Random(), rounds=3)  # noqa: S311 - any moment will do


@pytest.mark.slow
def test_replace_by_writer_killed_200_times_leaves_old_or_new_sequences(store: Store) -> None:
    kill_and_look(store, random.Random(), rounds=200)  # noqa: S311 - any moment will do


def test_sequence_name_after_killed_writer_is_available(store: Store) -> None:
    with writer(store, "drive") as process:
        assert process.stdout is not None
        assert [process.stdout.readline() for _ in range(2)] == ["ready\n", "open\n"]
    with writer(store, "drive") as second:
        assert second.wait(30) == 0
    assert_tidy(store)
    assert sources(store, "drive") == {1}


def test_collect_garbage_keeps_open_sessions_and_recent_files(
    store: Store, sink: StoreSink, rows: Rows, sample: OntologyType
) -> None:
    with sink.open("drive", {}) as session:
        topic = session.topic("/t", sample, {})
        topic.write(rows([1, 2]))
        topic.flush()
        assert store.collect_garbage(grace_s=0).sessions == 0
    orphan = store.paths("drive", "/t")[0].with_name("01ABC-0000.parquet")
    orphan.write_bytes(b"left by a crash")
    (store.layout.staging / "01ABD").mkdir()
    (store.layout.staging / "01ABD" / "0.parquet").write_bytes(b"begun")
    assert store.collect_garbage().sessions == 0
    collected = store.collect_garbage(grace_s=0)
    assert (collected.sessions, collected.files, collected.stored_bytes) == (1, 1, 5)
    assert store.scan("drive", "/t").read_all().num_rows == 2
    assert not orphan.exists()


def test_concurrent_writers_of_two_sequences_succeed(store: Store) -> None:
    with writer(store, "a", source=1) as one, writer(store, "b", source=2) as two:
        assert (one.wait(30), two.wait(30)) == (0, 0)
    assert (sources(store, "a"), sources(store, "b")) == ({1}, {2})


def test_concurrent_session_of_same_name_raises_sequence_exists(
    sink: StoreSink, store: Store, rows: Rows, sample: OntologyType
) -> None:
    with sink.open("drive", {}) as session:
        session.topic("/t", sample, {}).write(rows([1]))
        with pytest.raises(SequenceExists, match="another run"), sink.open("drive", {}):
            pytest.fail("the second session opened")
    assert store.sequence("drive").rows == 1


def test_concurrent_append_sessions_create_one_sequence(
    sink: StoreSink, store: Store, rows: Rows, sample: OntologyType
) -> None:
    with sink.open("drive", {}, if_exists=IfExists.APPEND) as one:
        one.topic("/t", sample, {}).write(rows([1]))
        with sink.open("drive", {}, if_exists=IfExists.APPEND) as two:
            two.topic("/t", sample, {}).write(rows([0]))
    assert store.scan("drive", "/t").read_all()["timestamp_ns"].to_pylist() == [0, 1]
    assert len(store.sequence("drive").sessions) == 2


def test_replace_after_concurrent_append_fails_and_keeps_its_rows(
    sink: StoreSink, store: Store, rows: Rows, sample: OntologyType
) -> None:
    with sink.open("drive", {}) as session:
        session.topic("/t", sample, {}).write(rows([1]))
    with (
        pytest.raises(SinkError, match="meanwhile"),
        sink.open("drive", {}, if_exists=IfExists.REPLACE),
        sink.open("drive", {}, if_exists=IfExists.APPEND) as other,
    ):
        other.topic("/t", sample, {}).write(rows([2]))
    assert store.sequence("drive").rows == 2


def test_append_to_concurrently_deleted_sequence_fails(
    sink: StoreSink, store: Store, rows: Rows, sample: OntologyType
) -> None:
    with sink.open("drive", {}) as session:
        session.topic("/t", sample, {}).write(rows([1]))
    with pytest.raises(SinkError, match="meanwhile"), sink.open("drive", {}, if_exists=IfExists.APPEND):
        store.delete_sequence("drive")
    assert store.sequences() == ()
    assert_tidy(store)


def test_delete_session_topic_or_sequence_removes_its_files(
    sink: StoreSink, store: Store, rows: Rows, sample: OntologyType
) -> None:
    for times in ([1, 2], [3]):
        with sink.open("drive", {}, if_exists=IfExists.APPEND) as session:
            session.topic("/a", sample, {}).write(rows(times))
            session.topic(f"/b/{len(times)}", sample, {}).write(rows(times))
    _, second = store.sequence("drive").sessions
    store.delete_session("drive", second.id)
    assert {topic.name: topic.rows for topic in store.sequence("drive").topics} == {"/a": 2, "/b/2": 2}
    store.delete_topic("drive", "a")
    assert [topic.name for topic in store.sequence("drive").topics] == ["/b/2"]
    assert len(list(store.layout.segment_files())) == 1
    store.delete_sequence("drive")
    assert list(store.layout.segments.iterdir()) == []
    for gone in (
        lambda: store.delete_sequence("drive"),
        lambda: store.delete_topic("drive", "a"),
        lambda: store.delete_session("drive", second.id),
    ):
        with pytest.raises(SinkError, match="no sequence 'drive'"):
            gone()


@pytest.mark.parametrize("disk_s", [0, 0.01], ids=["fast", "slow"])
def test_commit_syncs_files_and_folders_before_catalog(
    store: Store,
    sink: StoreSink,
    rows: Rows,
    sample: OntologyType,
    monkeypatch: pytest.MonkeyPatch,
    *,
    disk_s: float,
) -> None:
    """Check the order of fsync calls, since a test cannot cut the power."""
    names = ("/a", "/b/c", "/d", "/e", "/f")
    calls: list[tuple[str, Path]] = []
    settle, move, enter = layout.fsync, layout._move, Catalog.commit

    def fsync(path: Path) -> None:
        time.sleep(disk_s)
        settle(path)
        calls.append(("fsync", path))

    def moved(staged: Path, target: Path) -> None:
        move(staged, target)
        calls.append((f"from {staged}", target))

    def commit(self: Catalog, *given: Any) -> list[str]:
        calls.append(("commit", self.path))
        return enter(self, *given)

    monkeypatch.setattr(layout, "fsync", fsync)
    monkeypatch.setattr(layout, "_move", moved)
    monkeypatch.setattr(Catalog, "commit", commit)
    with sink.open("drive", {}) as session:
        for name in names:
            session.topic(name, sample, {}).write(rows([1, 2]))
    named = calls.index(("commit", store.path / "catalog.sqlite"))
    for name in names:
        (path,) = store.paths("drive", name)
        at, step = next((at, step) for at, (step, target) in enumerate(calls) if target == path)
        assert calls.index(("fsync", Path(step.removeprefix("from ")))) < at
        folders = [folder for folder in path.parents if folder.is_relative_to(store.path / "segments")]
        assert len(folders) > 2
        assert all(at < calls.index(("fsync", folder)) < named for folder in folders)
