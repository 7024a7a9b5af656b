"""Python and notebooks: one-call functions, topics as tables and frames, short reprs, and types for users."""

from __future__ import annotations

import os
import pydoc
import subprocess
import sys
from collections.abc import Callable
from datetime import datetime, timezone
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

import mosaico_ingest
from mosaico_ingest import Store
from mosaico_ingest.destinations.store import SequenceInfo, TopicInfo
from mosaico_ingest.documents import html_table
from mosaico_ingest.errors import IngestError, ManifestError, SinkError
from mosaico_ingest.report.run import RunReport

ROOT = Path(__file__).resolve().parents[1]
DRIVE = ROOT / "configs" / "quickstart" / "drive.mcap"
START_NS = 1767225600000050000


@pytest.fixture(scope="module")
def manifest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("notebook")
    text = f"bag: {{path: {DRIVE}}}\nsequence: {{name: yard}}\ntopics: [/imu, /joint_states]\n"
    (folder / "job.yaml").write_text(f"{text}target: {{store: {folder / 'store'}}}\n")
    return folder / "job.yaml"


@pytest.fixture(scope="module")
def report(manifest: Path) -> RunReport:
    return mosaico_ingest.run(str(manifest))


@pytest.fixture(scope="module")
def sequence(manifest: Path, report: RunReport) -> SequenceInfo:
    assert report.exit_code == 0
    return Store.open(manifest.parent / "store", create=False).sequence("yard")


@pytest.fixture(scope="module")
def imu(sequence: SequenceInfo) -> TopicInfo:
    return sequence.topic("/imu")


def test_run_manifest_returns_report_with_manifest(report: RunReport, manifest: Path) -> None:
    assert [one.sequence for one in report.recordings] == ["yard"]
    assert [used.path for used in report.manifests] == [str(manifest)]
    with pytest.raises(ManifestError):
        mosaico_ingest.run(manifest.parent / "missing.yaml")


def test_plan_and_inspect_take_paths_as_text(manifest: Path) -> None:
    assert mosaico_ingest.plan(str(manifest)).exit_code in {0, 1}
    assert len(mosaico_ingest.inspect(str(DRIVE)).topics) > 5


@pytest.mark.parametrize(
    ("start", "end", "rows"),
    [
        (None, None, 1000),
        ("+1s", "+2s", 100),
        ("-1s", None, 101),
        (START_NS, START_NS + 10**9, 100),
        (datetime(2026, 1, 1, 0, 0, 9, tzinfo=timezone.utc), None, 100),
        (datetime(2026, 1, 1, 0, 0, 9), "2026-01-01T00:00:09.5Z", 50),  # noqa: DTZ001 - UTC by default
        ("2027-01-01", None, 0),
    ],
)
def test_to_arrow_selects_time_range(imu: TopicInfo, start: Any, end: Any, rows: int) -> None:
    assert imu.to_arrow(start, end, ["header"]).num_rows == rows


def test_to_arrow_selects_columns_and_flattens(imu: TopicInfo) -> None:
    assert imu.to_arrow(columns=["acceleration.z", "header"]).schema.names == [
        "timestamp_ns",
        "acceleration.z",
        "header",
    ]
    flat = imu.to_arrow(end="+1s", columns=["header"], flatten=True)
    assert "header.timestamp.seconds" in flat.schema.names
    assert imu.to_arrow("+1s", "+1.01s", ["acceleration.z"]).to_pylist() == [
        {"timestamp_ns": START_NS + 10**9, "acceleration.z": 9.81}
    ]


def test_topic_frames_have_equal_rows(imu: TopicInfo) -> None:
    columns = ["acceleration.z"]
    expected = imu.to_arrow("+1s", "+2s", columns)
    assert imu.to_pandas("+1s", "+2s", columns)["acceleration.z"].tolist() == [9.81] * 100
    assert imu.to_polars("+1s", "+2s", columns).to_arrow().equals(expected)
    assert imu.to_duckdb("+1s", "+2s", columns).aggregate("count(*)").fetchall() == [(100,)]
    assert imu.to_reader("+1s", "+2s", ["acceleration"]).read_all().num_rows == 100


@pytest.mark.parametrize(
    "call",
    [
        lambda topic: topic.to_arrow(columns=["acc"]),
        lambda topic: topic.to_arrow(columns=["acceleration.q"]),
        lambda topic: topic.to_arrow("noon"),
        lambda topic: topic.to_reader(columns=["acceleration.z"]),
    ],
)
def test_to_arrow_unknown_column_or_time_raises_sink_error(
    imu: TopicInfo, call: Callable[[TopicInfo], object]
) -> None:
    with pytest.raises(SinkError):
        call(imu)


def test_sequence_unknown_topic_raises_error_with_hint(sequence: SequenceInfo) -> None:
    with pytest.raises(SinkError, match="/imu"):
        sequence.topic("imo")
    assert sequence.topic("imu") == sequence.topic("/imu")


@pytest.mark.parametrize(("library", "method"), [("polars", "to_polars"), ("duckdb", "to_duckdb")])
def test_frame_without_its_library_names_the_extra(
    imu: TopicInfo, monkeypatch: pytest.MonkeyPatch, library: str, method: str
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(IngestError, match=r"mosaico-ingest\[(frames|sql)\]"):
        getattr(imu, method)(end="+1s")


class Cells(HTMLParser):
    """Collects the text of cells and checks that tags are balanced."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.texts: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        del attrs
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def texts(page: str) -> list[str]:
    cells = Cells()
    cells.feed(page)
    assert not cells.open
    return cells.texts


def test_reprs_are_one_short_line_and_tables_name_their_content(
    manifest: Path, report: RunReport, sequence: SequenceInfo, imu: TopicInfo
) -> None:
    plan = mosaico_ingest.plan(manifest)
    shown = {
        "<RunReport: 1 recording, 0 failed, 1,500 messages written>": report,
        "<Report yard: completed, 1,500 of 1,500 messages written>": report.recordings[0],
        "<Plan yard: 2 topics, 1,500 messages, 8 excluded>": plan,
        f"<Store {manifest.parent / 'store'}>": Store.open(manifest.parent / "store"),
    }
    for text, value in shown.items():
        assert repr(value) == text
    assert repr(sequence).startswith("<Sequence yard: 2 topics, 1,500 rows, ")
    assert repr(imu).startswith("<Topic yard/imu: IMU, 1,000 rows, ")
    for value in (report, report.recordings[0], plan, sequence, mosaico_ingest.inspect(DRIVE)):
        assert "/imu" in texts(value._repr_html_())
    assert "yard" in texts(Store.open(manifest.parent / "store")._repr_html_())
    assert "acceleration" in texts(imu._repr_html_())


def test_run_report_of_several_recordings_shows_a_row_for_each(report: RunReport) -> None:
    (one,) = report.recordings
    several = report.model_copy(update={"recordings": (one, one.model_copy(update={"sequence": "other"}))})
    assert {"yard", "other"} <= set(texts(several._repr_html_()))


def test_html_table_escapes_text_and_limits_rows() -> None:
    page = html_table("<b>", ["<i>"], (["<script>"] for _ in range(500)), count=500, notes=["&"])
    shown = texts(page)
    assert shown.count("<script>") == 100
    assert {"<b>", "<i>", "… and 400 more", "&"} <= set(shown)


def test_help_starts_with_ten_names() -> None:
    text = pydoc.plain(pydoc.render_doc(mosaico_ingest)).split("PACKAGE CONTENTS")[0]
    lines = [line.strip() for line in text.split("Start with these names:")[1].splitlines()]
    names = [line.split("(")[0].split(".")[0].split()[0] for line in lines if line][:10]
    assert set(names) <= set(mosaico_ingest.__all__)
    assert len(set(names)) == 10
    assert text.index("Start with these names") < 400


PROGRAM = """
from datetime import datetime

import mosaico_ingest
from mosaico_ingest import Store

report = mosaico_ingest.run("job.yaml")
code: int = report.exit_code
written: int = report.recordings[0].totals.written
plan_code: int = mosaico_ingest.plan("job.yaml").exit_code
names: list[str] = [topic.topic for topic in mosaico_ingest.inspect("drive.mcap").topics]
imu = Store.open("mosaico", create=False).sequence("yard").topic("/imu")
rows: int = imu.rows
table = imu.to_arrow("+1s", datetime(2026, 1, 1), ["acceleration.z"], flatten=True)
frame = imu.to_pandas(start=0, columns=["header"])
relation = imu.to_duckdb()
polars_frame = imu.to_polars(flatten=True)
"""
MISTAKES = """
import mosaico_ingest

code: str = mosaico_ingest.run("job.yaml").exit_code
mosaico_ingest.runn
mosaico_ingest.Store.open("mosaico").sequence("yard").topic(1)
"""


@pytest.mark.slow
def test_public_functions_pass_strict_mypy_in_user_code(tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    (tmp_path / "program.py").write_text(PROGRAM)
    (tmp_path / "mistakes.py").write_text(MISTAKES)
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--strict",
        "--follow-imports=silent",
        "--cache-dir",
        str(tmp_path / "c"),
    ]
    environment = {**os.environ, "MYPYPATH": str(ROOT)}

    def check(name: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(  # noqa: S603 - our own code
            [*command, name], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )

    program, mistakes = check("program.py"), check("mistakes.py")
    assert program.returncode == 0, program.stdout
    assert "Found 3 errors" in mistakes.stdout, mistakes.stdout
