"""Excerpts of logs prefer warnings and errors."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pytest
from stored_sequences import LOG, TEXT, ontology, write_sequence

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.view.texts import LogLine, has_log, read_excerpt

DIAGNOSTICS = ontology(
    "DiagnosticArray",
    status=pa.list_(pa.struct({"level": pa.binary(), "name": pa.string(), "message": pa.string()})),
)


def log_rows(*levels: int) -> list[dict[str, object]]:
    return [
        {"timestamp_ns": at, "level": level, "name": "node", "msg": f"line {at}"}
        for at, level in enumerate(levels)
    ]


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store.open(tmp_path)


@pytest.mark.parametrize(("info", "warning", "error"), [(2, 4, 8), (20, 30, 40)])
def test_excerpt_of_log_has_the_severe_lines(store: Store, info: int, warning: int, error: int) -> None:
    write_sequence(store, "s", {"/log": (LOG, log_rows(info, warning, info, error))})
    excerpt = read_excerpt(store.topic("s", "/log"))
    assert excerpt is not None
    assert [(line.time_ns, line.level) for line in excerpt.lines] == [(1, "warning"), (3, "error")]
    assert excerpt.counts == {"info": 2, "warning": 1, "error": 1}
    assert excerpt.is_severe


def test_excerpt_of_log_without_severe_lines_has_the_first_lines(store: Store) -> None:
    write_sequence(store, "s", {"/log": (LOG, log_rows(2, 2, 2))})
    excerpt = read_excerpt(store.topic("s", "/log"), count=2)
    assert excerpt is not None
    assert [line.text for line in excerpt.lines] == ["line 0", "line 1"]
    assert not excerpt.is_severe


def test_excerpt_of_diagnostics_has_one_line_per_status(store: Store) -> None:
    rows = [
        {
            "timestamp_ns": 5,
            "status": [
                {"level": b"\x00", "name": "a", "message": "fine"},
                {"level": b"\x02", "name": "b", "message": "hot"},
            ],
        }
    ]
    write_sequence(store, "s", {"/d": (DIAGNOSTICS, rows)})
    excerpt = read_excerpt(store.topic("s", "/d"))
    assert excerpt is not None
    assert excerpt.lines == (LogLine(5, "error", "b", "hot"),)


def test_excerpt_of_texts_has_no_levels(store: Store) -> None:
    write_sequence(store, "s", {"/t": (TEXT, [{"timestamp_ns": 1, "data": "x" * 1000}])})
    excerpt = read_excerpt(store.topic("s", "/t"))
    assert excerpt is not None
    assert [(line.level, len(line.text)) for line in excerpt.lines] == [("", 500)]


def test_topic_of_numbers_has_no_log(store: Store) -> None:
    write_sequence(store, "s", {"/n": (ontology("N", value=pa.int32()), [{"timestamp_ns": 1, "value": 1}])})
    assert not has_log(store.topic("s", "/n"))
