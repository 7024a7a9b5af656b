"""Groups of split files without a metadata.yaml: names, numbers, gaps, and recordings of the corpus."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import define, record

from mosaico_ingest import api
from mosaico_ingest.job.values import FileNamePattern
from mosaico_ingest.rosbag.discovery import group_splits, numbering_gaps

CORPUS = Path(__file__).parents[3] / "shared" / "corpus"
INT = define("std_msgs/msg/Int32", "int32 data")


def grouped(names: Sequence[str], pattern: str | None = None) -> dict[str, list[str]]:
    """Return the files of each recording by its stem, or by its file if it has no splits."""
    number_of = None if pattern is None else FileNamePattern(pattern).match
    groups = group_splits([Path(name) for name in names], number_of)
    return {group.stem or str(group.files[0]): list(map(str, group.files)) for group in groups}


@pytest.mark.parametrize(
    ("names", "groups"),
    [
        (["x_0.db3", "x_1.db3", "y.db3"], {"x": ["x_0.db3", "x_1.db3"], "y.db3": ["y.db3"]}),
        (["x_10.db3", "x_9.db3", "x_0.db3"], {"x": ["x_0.db3", "x_9.db3", "x_10.db3"]}),
        (["x_1.db3", "x_2.db3"], {"x_1.db3": ["x_1.db3"], "x_2.db3": ["x_2.db3"]}),
        (["x_0.db3"], {"x_0.db3": ["x_0.db3"]}),
        (["x_0.db3", "x_1.mcap"], {"x_0.db3": ["x_0.db3"], "x_1.mcap": ["x_1.mcap"]}),
        (["a/x_0.db3", "b/x_1.db3"], {"a/x_0.db3": ["a/x_0.db3"], "b/x_1.db3": ["b/x_1.db3"]}),
        (["x_0.db3", "x_00.db3"], {"x_0.db3": ["x_0.db3"], "x_00.db3": ["x_00.db3"]}),
        (["x_0.bag", "x_1.bag.active"], {"x": ["x_0.bag", "x_1.bag.active"]}),
        (["x_0.db3.zstd", "x_1.db3.zstd"], {"x": ["x_0.db3.zstd", "x_1.db3.zstd"]}),
        (
            [
                "d_2026-03-01-10-00-00_0.bag",
                "d_2026-03-01-10-05-00_1.bag",
                "d_2026-03-02-09-00-00_0.bag",
                "d_2026-03-02-09-05-00_1.bag",
            ],
            {
                "d_2026-03-01-10-00-00": ["d_2026-03-01-10-00-00_0.bag", "d_2026-03-01-10-05-00_1.bag"],
                "d_2026-03-02-09-00-00": ["d_2026-03-02-09-00-00_0.bag", "d_2026-03-02-09-05-00_1.bag"],
            },
        ),
    ],
)
def test_group_splits_auto_groups_numbered_files(names: list[str], groups: dict[str, list[str]]) -> None:
    assert grouped(names) == groups


def test_group_splits_pattern_groups_equal_fields() -> None:
    names = ["r1-part3.mcap", "r1-part4.mcap", "r2-part1.mcap", "notes.mcap"]
    assert grouped(names, "{stem}-part{split:int}") == {
        "r1": ["r1-part3.mcap", "r1-part4.mcap"],
        "r2": ["r2-part1.mcap"],
        "notes.mcap": ["notes.mcap"],
    }


@given(
    st.lists(st.tuples(st.sampled_from(["x", "y_1", "z"]), st.integers(0, 12)), unique=True),
    st.randoms(use_true_random=False),
)
def test_group_splits_keeps_every_file_once_and_orders_splits(
    names: list[tuple[str, int]], random: Random
) -> None:
    files = [Path(f"{stem}_{number}.mcap") for stem, number in names]
    random.shuffle(files)
    groups = group_splits(files)
    assert sorted(file for group in groups for file in group.files) == sorted(files)
    for group in groups:
        stems = {file.stem.rpartition("_")[0] for file in group.files}
        numbers = [int(file.stem.rpartition("_")[2]) for file in group.files]
        assert len(stems) == 1
        assert numbers == sorted(numbers)
        own = {number for stem, number in names if stem in stems}
        assert (len(group.files) > 1) == (0 in own and len(own) > 1)


@pytest.mark.parametrize(
    ("names", "from_zero", "messages"),
    [
        (["x_0.db3", "x_1.db3"], True, []),
        (["x_0.db3", "x_2.db3"], False, ["x: no file has the number 1"]),
        (["x_0.db3", "x_5.db3"], False, ["x: no file has the number 1 to 4"]),
        (["x_1.db3", "x_2.db3"], True, ["x: no file has the number 0"]),
        (["x_1.db3", "x_2.db3"], False, []),
        (["x_0.db3", "x_2.db3", "other.db3"], False, []),
    ],
)
def test_numbering_gaps_reports_missing_numbers(
    *, names: list[str], from_zero: bool, messages: list[str]
) -> None:
    findings = list(numbering_gaps([Path(name) for name in names], from_zero=from_zero))
    assert [finding.message for finding in findings] == messages
    assert {finding.rule for finding in findings} <= {"split-gap"}


def project(folder: Path, numbers: Sequence[int], **bag: str) -> Path:
    for number in numbers:
        record(folder / f"drive_{number}.mcap", [("/a", INT, 10**9 * (number + 1), {"data": number})])
    job = folder / "job.yaml"
    job.write_text(json.dumps({"bag": {"path": "*.mcap", **bag}, "target": {"store": "store"}}))
    return job


def test_glob_of_splits_becomes_one_sequence_named_by_stem(tmp_path: Path) -> None:
    report = api.run(project(tmp_path, (1, 0, 2)))
    assert [(one.sequence, one.totals.written) for one in report.recordings] == [("drive", 3)]


def test_glob_of_splits_without_grouping_becomes_one_sequence_each(tmp_path: Path) -> None:
    jobs = api.compile_job(project(tmp_path, (0, 1), group="none"))
    assert [job.sequence.name for job in jobs] == ["drive_0", "drive_1"]


def test_plan_of_grouped_splits_reports_group_and_gap(tmp_path: Path) -> None:
    (recording,) = api.plan_job(project(tmp_path, (0, 2))).recordings
    rules = {note.rule: note.location for note in recording.notes}
    assert rules.keys() >= {"grouped-splits", "split-gap"}
    assert str(rules["grouped-splits"]).endswith("job.yaml:1:10")


def test_folder_with_pattern_becomes_one_sequence_per_stem(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    project(folder, (0, 1))
    record(folder / "other_4.mcap", [("/a", INT, 1, {"data": 1})])
    job = tmp_path / "job.yaml"
    job.write_text('bag: {path: folder, group: "{stem}_{split:int}"}')
    assert [(one.sequence.name, len(one.paths)) for one in api.compile_job(job)] == [
        ("drive", 2),
        ("other", 1),
    ]


@pytest.mark.skipif(not CORPUS.is_dir(), reason="the corpus is not on this machine")
@pytest.mark.parametrize(
    ("folder", "stem"),
    [
        ("ros2__rosbag2/multiple_files", "multiple_files"),
        ("ros2__rosbag2/multiple_files_mcap", "multiple_files"),
        ("Extelligence-ai__bagel/sample_ros2_db3", "part"),
    ],
)
def test_corpus_splits_without_metadata_equal_recording_with_metadata(
    tmp_path: Path, folder: str, stem: str
) -> None:
    for file in (CORPUS / folder).iterdir():
        if file.suffix in {".db3", ".mcap"}:
            shutil.copy(file, tmp_path / file.name)
    job = tmp_path / "job.yaml"
    job.write_text(f'bag: {{path: "{stem}_*"}}\ntarget: {{store: grouped}}\n')
    (grouped_report,) = api.run(job).recordings
    job.write_text(
        f"bag: {{path: {CORPUS / folder}}}\nsequence: {{name: {stem}}}\ntarget: {{store: listed}}\n"
    )
    (listed_report,) = api.run(job).recordings
    assert grouped_report.sequence == stem
    assert [(t.topic, t.checksum) for t in grouped_report.topics if t.written] == [
        (t.topic, t.checksum) for t in listed_report.topics if t.written
    ]
