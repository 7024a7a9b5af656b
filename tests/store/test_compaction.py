"""Compaction: rows, their order and checksums stay the same, beside readers, writers and kills."""

from __future__ import annotations

import json
import random
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from store_formats import make_format_1
from typer.testing import CliRunner

from mosaico_ingest.cli.app import command_line, main
from mosaico_ingest.destinations.store import Store, StoreSink, compaction
from mosaico_ingest.destinations.store import files as layout
from mosaico_ingest.destinations.store.catalog import Catalog
from mosaico_ingest.destinations.store.compaction import compact
from mosaico_ingest.destinations.store.store import Window, scan, verify
from mosaico_ingest.errors import SinkError
from mosaico_ingest.job.values import Compression, IfExists
from mosaico_ingest.ontology.registry import OntologyType

Rows = Callable[..., pa.RecordBatch]
RUN = CliRunner()


def append(store: Store, sample: OntologyType, batch: pa.RecordBatch) -> None:
    with StoreSink(store).open("s", {}, if_exists=IfExists.APPEND) as session:
        session.topic("/t", sample, {}).write(batch)


def append_all(store: Store, sample: OntologyType, sessions: Sequence[pa.RecordBatch]) -> None:
    for batch in sessions:
        append(store, sample, batch)


def content(store: Store) -> list[dict[str, Any]]:
    return store.scan("s", "/t").read_all().to_pylist()


def run(store: Store, **options: Any) -> list[compaction.Compacted]:
    return list(compact(store, store.sequence("s"), **options))


@settings(max_examples=15, deadline=None)
@given(
    sessions=st.lists(st.lists(st.integers(0, 12), min_size=1, max_size=5), min_size=1, max_size=7),
    max_bytes=st.sampled_from([1, 4000, 1 << 20]),
)
def test_compaction_of_any_sessions_keeps_rows_order_and_checksum(
    tmp_path_factory: pytest.TempPathFactory,
    rows: Rows,
    sample: OntologyType,
    sessions: list[list[int]],
    max_bytes: int,
) -> None:
    store = Store.open(tmp_path_factory.mktemp("any") / "store")
    append_all(store, sample, [rows(times, number) for number, times in enumerate(sessions)])
    before, rows_before = store.topic("s", "/t"), content(store)
    results = run(store, max_bytes=max_bytes)
    after = store.topic("s", "/t")
    assert [result.problem for result in results] == [None] * len(results)
    assert len(after.segments) == len(before.segments) - sum(each.segments - 1 for each in results)
    assert content(store) == rows_before
    assert (after.checksum, after.rows, after.start_ns, after.end_ns) == (
        before.checksum, before.rows, before.start_ns, before.end_ns,
    )  # fmt: skip
    assert [each.problem for each in verify(store.sequence("s"))] == [None] * len(after.segments)
    if max_bytes == 1 << 20:
        assert len(after.segments) == 1
        assert run(store) == []


def test_reader_that_opened_sequence_earlier_finishes_and_gc_removes_files(
    store: Store, rows: Rows, sample: OntologyType
) -> None:
    append_all(store, sample, [rows([at, at + 1], at) for at in range(0, 40, 2)])
    earlier, expected = store.topic("s", "/t"), content(store)
    assert [result.segments for result in run(store, compression=Compression.SMALL)] == [20]
    table = pa.Table.from_batches(scan(earlier.segments, earlier.schema, Window()), earlier.schema)
    assert table.to_pylist() == expected
    assert len(list(store.layout.segment_files())) == 21
    store.collect_garbage(grace_s=0)
    assert set(store.layout.segment_files()) == set(store.paths("s", "/t"))
    assert content(store) == expected


def test_later_sessions_are_compacted_again(store: Store, rows: Rows, sample: OntologyType) -> None:
    append_all(store, sample, [rows([at], at) for at in range(5)])
    run(store)
    checksum = store.topic("s", "/t").checksum
    append_all(store, sample, [rows([at], at) for at in range(5, 8)])
    run(store)
    (segment,) = store.topic("s", "/t").segments
    assert len(segment.merged) == 8
    assert store.topic("s", "/t").checksum != checksum
    assert [row["source"] for row in content(store)] == list(range(8))


def test_session_of_merged_segment_cannot_be_deleted(store: Store, rows: Rows, sample: OntologyType) -> None:
    append_all(store, sample, [rows([at], at) for at in range(3)])
    run(store)
    session = store.sequence("s").sessions[0].id
    with pytest.raises(SinkError, match=session):
        store.delete_session("s", session)
    assert len(content(store)) == 3
    store.delete_sequence("s")


def test_damaged_segment_stays_with_its_neighbors(store: Store, rows: Rows, sample: OntologyType) -> None:
    append_all(store, sample, [rows([at], at) for at in range(3)])
    path = store.paths("s", "/t")[1]
    Path(str(path)).write_bytes(Path(str(path)).read_bytes()[:-10])
    (result,) = run(store)
    assert result.is_damaged
    assert str(path) in str(result.problem)
    assert len(store.paths("s", "/t")) == 3


@pytest.mark.parametrize("change", ["append", "replace", "delete"])
def test_writer_during_compaction_wins(
    store: Store, rows: Rows, sample: OntologyType, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    append_all(store, sample, [rows([at], at) for at in range(4)])
    publish = layout.LocalFiles.publish

    def change_then_publish(self: layout.LocalFiles, moves: Any) -> None:
        monkeypatch.undo()
        if change == "append":
            append(store, sample, rows([2], 9))
        elif change == "replace":
            with StoreSink(store).open("s", {}, if_exists=IfExists.REPLACE) as session:
                session.topic("/t", sample, {}).write(rows([7], 7))
        else:
            store.delete_sequence("s")
        publish(self, moves)

    monkeypatch.setattr(layout.LocalFiles, "publish", change_then_publish)
    (result,) = run(store)
    sources = [row["source"] for row in content(store)] if change != "delete" else []
    assert (result.problem is None) == (change == "append")
    assert sources == {"append": [0, 1, 2, 9, 3], "replace": [7], "delete": []}[change]
    store.collect_garbage(grace_s=0)
    known = set() if change == "delete" else set(store.paths("s", "/t"))
    assert set(store.layout.segment_files()) == known


def test_catalog_of_format_1_is_converted_by_first_compaction(
    store: Store, rows: Rows, sample: OntologyType
) -> None:
    append_all(store, sample, [rows([at], at) for at in range(3)])
    expected = content(store)
    make_format_1(store.layout.root)
    old = Store.open(store.layout.root, create=False)
    assert content(old) == expected
    assert [result.segments for result in run(old)] == [3]
    assert content(old) == expected


COMPACT = """
import sys
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.destinations.store.compaction import compact
store = Store.open(sys.argv[1])
print("ready", flush=True)
for result in compact(store, store.sequence("s")):
    assert result.problem is None, result
"""


def kill_and_look(store: Store, rows: Rows, sample: OntologyType, rounds: int) -> None:
    """Append sessions and kill a compaction at a random moment, repeatedly."""
    moments = random.Random()  # noqa: S311 - any moment will do
    number = 0
    for _ in range(rounds):
        for _ in range(4):
            append(store, sample, rows(np.arange(number, number + 50), number))
            number += 50
        expected, checksum = content(store), store.topic("s", "/t").checksum
        with subprocess.Popen(  # noqa: S603 - this interpreter, our own script
            [sys.executable, "-c", COMPACT, str(store.path)], stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            time.sleep(moments.random() * 0.03)
            process.kill()
        assert content(store) == expected
        assert store.topic("s", "/t").checksum == checksum
    store.collect_garbage(grace_s=0)
    assert set(store.layout.segment_files()) == set(store.paths("s", "/t"))
    assert store.layout.open_sessions() == []
    assert [each.problem for each in verify(store.sequence("s")) if each.problem] == []
    run(store)
    assert content(store) == expected


def test_killed_compaction_keeps_rows_and_next_one_completes(
    store: Store, rows: Rows, sample: OntologyType
) -> None:
    kill_and_look(store, rows, sample, 1)


@pytest.mark.slow
def test_compaction_killed_six_times_keeps_rows(store: Store, rows: Rows, sample: OntologyType) -> None:
    kill_and_look(store, rows, sample, 6)


@pytest.mark.parametrize("step", ["write", "publish", "replace"])
def test_compaction_that_ends_at_a_step_keeps_rows(
    store: Store, rows: Rows, sample: OntologyType, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    append_all(store, sample, [rows([at], at) for at in range(3)])
    expected = content(store)

    def end(*_: object) -> None:
        raise KeyboardInterrupt

    targets = {
        "write": (compaction, "_write"),
        "publish": (layout.LocalFiles, "publish"),
        "replace": (Catalog, "replace_segments"),
    }
    monkeypatch.setattr(*targets[step], end)
    with pytest.raises(KeyboardInterrupt):
        run(store)
    monkeypatch.undo()
    assert content(store) == expected
    store.collect_garbage(grace_s=0)
    assert set(store.layout.segment_files()) == set(store.paths("s", "/t"))
    assert [result.segments for result in run(store)] == [3]


def test_compact_command_prints_each_topic_and_reports_damage_with_exit_code_5(
    store: Store, rows: Rows, sample: OntologyType
) -> None:
    append_all(store, sample, [rows([at], at) for at in range(3)])
    command = ["store", "compact", "s", "--store", str(store.path)]
    result = RUN.invoke(command_line(), [*command, "--json"])
    (printed,) = json.loads(result.stdout)
    assert (printed["sequence"], printed["topic"], printed["files"], printed["problem"]) == (
        "s",
        "/t",
        3,
        None,
    )
    assert printed["bytes_after"] == store.topic("s", "/t").stored_bytes
    assert RUN.invoke(command_line(), command).stdout == "nothing to compact\n"
    append_all(store, sample, [rows([at], at) for at in range(5, 7)])
    Path(str(store.paths("s", "/t")[2])).write_bytes(b"")
    with pytest.raises(SystemExit) as ended:
        main(command)
    assert ended.value.code == 5
