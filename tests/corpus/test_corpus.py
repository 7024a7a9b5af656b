"""Real recordings, through the complete pipeline."""

from __future__ import annotations

import csv
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pyarrow as pa
import pytest

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.report.events import TopicStatus

TABLE = Path(__file__).with_name("table.tsv")
ORDER = ("refused", "part", "whole")


def _survey() -> ModuleType:
    """Load the script beside this file; tests are no package to import it from."""
    spec = importlib.util.spec_from_file_location("corpus_survey", Path(__file__).with_name("survey.py"))
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


SURVEY = _survey()
WHOLE = [
    "rerun-io__rerun/rosbag2_2025_09_10-13_03_56_0.mcap",
    "cra-ros-pkg__robot_localization/*.bag",
    "ctu-vras__ros-utils/*.bag",
    "berndpfrommer__tagslam/*.bag",
]


def tables(recording: Path, folder: Path) -> dict[str, bytes]:
    """Ingest a recording and return its topics as Arrow IPC, which equals itself where a column has NaN."""
    report = SURVEY.report_of(recording, folder)
    assert report.error is None
    store, actual = Store.open(folder), dict[str, bytes]()
    for topic in report.topics:
        if topic.status is TopicStatus.WRITTEN:
            rows = store.scan("survey", topic.target).read_all().combine_chunks()
            sink = pa.BufferOutputStream()
            with pa.ipc.new_stream(sink, rows.schema) as writer:
                writer.write_table(rows)
            actual[topic.target] = sink.getvalue().to_pybytes()
    return actual


@pytest.mark.slow
def test_recording_compressed_three_ways_gives_identical_tables(corpus: Path, tmp_path: Path) -> None:
    plain, bz2, lz4 = (
        tables(corpus / "foxglove__rosbag" / f"example{kind}.bag", tmp_path / f"store{kind}")
        for kind in ("", "-bz2", "-lz4")
    )
    assert plain
    assert plain == bz2 == lz4


@pytest.mark.slow
def test_corpus_recording_result_is_at_least_that_of_the_table(corpus: Path) -> None:
    with TABLE.open(encoding="utf-8", newline="") as file:
        before = {row["path"]: row for row in csv.DictReader(file, delimiter="\t")}
    worse = list[str]()
    for row in SURVEY.survey(corpus):
        known = before[row.path]
        assert not row.wrong, f"{row.path}: {row.wrong}"
        if ORDER.index(row.outcome) < ORDER.index(known["outcome"]) or row.written < int(known["written"]):
            worse.append(
                f"{row.path}: {known['outcome']} {known['written']} -> {row.outcome} {row.written}: {row.why}"
            )
    assert worse == []


@pytest.mark.slow
@pytest.mark.parametrize("pattern", WHOLE)
def test_corpus_recording_of_known_types_is_ingested_completely(corpus: Path, pattern: str) -> None:
    rows = list(SURVEY.survey(corpus, [pattern]))
    assert rows
    for row in rows:
        assert (row.outcome, row.why, row.wrong) == ("whole", "", ""), row.path
        assert row.read == row.written == row.known_messages, row.path
