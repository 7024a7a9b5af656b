"""`ingest status` reports the state of each recording, and shards partition the recordings."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner, Result

from mosaico_ingest.cli.app import command_line
from mosaico_ingest.cli.run import take_shard
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import ManifestError
from mosaico_ingest.lazy import LazySequence
from mosaico_ingest.report.parts import Step
from mosaico_ingest.report.run import RunReport

DRIVE = Path(__file__).resolve().parents[2] / "configs" / "quickstart" / "drive.mcap"


@pytest.fixture
def job(tmp_path: Path) -> Path:
    for name in ("a", "b", "c"):
        shutil.copy(DRIVE, tmp_path / f"{name}.mcap")
    manifest = tmp_path / "job.yaml"
    manifest.write_text('bag: {path: "*.mcap"}\ntopics: [/imu]\ntarget: {store: store}\n')
    return manifest


def ingest(*arguments: str | Path) -> Result:
    return CliRunner().invoke(command_line(), [str(argument) for argument in arguments])


def statuses(job: Path) -> dict[str, str]:
    return {one["sequence"]: one["status"] for one in json.loads(ingest("status", job, "--json").stdout)}


def test_status_reports_each_recording(job: Path) -> None:
    assert statuses(job) == {"a": "new", "b": "new", "c": "new"}
    assert ingest("run", job, "--quiet").exit_code == 0
    assert statuses(job) == {"a": "done", "b": "done", "c": "done"}
    assert ingest("status", job, "--check").exit_code == 0

    (job.parent / "a.mcap").write_bytes(DRIVE.read_bytes() + b"\n")
    (job.parent / "b.mcap").write_bytes(b"torn")
    Store.open(job.parent / "store").add_note("c", "the run ended early")
    shutil.copy(DRIVE, job.parent / "d.mcap")
    assert statuses(job) == {"a": "changed", "b": "unreadable", "c": "failed", "d": "new"}
    assert ingest("status", job, "--check").exit_code == 1


def test_shards_together_ingest_everything_once(job: Path) -> None:
    for number in (1, 2):
        report = job.parent / f"r{number}.json"
        assert ingest("run", job, "--shard", f"{number}/2", "--report", report, "--quiet").exit_code == 0
    assert Store.open(job.parent / "store").names() == ("a", "b", "c")
    page = job.parent / "out.html"
    merged = ingest("report", job.parent / "r1.json", job.parent / "r2.json", "--html", page)
    assert merged.exit_code == 0
    assert "3 recordings" in page.read_text()


def test_shard_without_recordings_exits_0(job: Path) -> None:
    report = job.parent / "r.json"
    assert ingest("run", job, "--shard", "9/9", "--report", report).exit_code == 0
    assert RunReport.model_validate_json(report.read_text()).recordings == ()


def test_json_lines_and_metrics_report_the_run(job: Path) -> None:
    metrics = job.parent / "ingest.prom"
    result = ingest("run", job, "--log-format", "json", "--metrics", metrics)
    events = [json.loads(line) for line in result.stderr.splitlines()]
    assert [one["event"] for one in events if one["sequence"] == "b"] == ["started", "finished"]
    assert {one["read"] for one in events if one["event"] == "finished"} == {1000}
    lines = metrics.read_text().splitlines()
    assert 'mosaico_ingest_messages{fate="written"} 3000' in lines
    assert 'mosaico_ingest_messages{fate="unreadable"} 0' in lines
    spent = dict(line.split() for line in lines if line.startswith("mosaico_ingest_step_seconds"))
    assert float(spent['mosaico_ingest_step_seconds{step="commit"}']) > 0
    assert len(spent) == len(Step)


@given(st.lists(st.integers()), st.integers(1, 12))
def test_shards_partition_the_recordings(items: list[int], count: int) -> None:
    parts = [take_shard(LazySequence.of(items), f"{number}/{count}") for number in range(1, count + 1)]
    assert sorted(item for part in parts for item in part) == sorted(items)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.parametrize("text", ["0/2", "3/2", "1", "a/b", "1/0", ""])
def test_shard_accepts_only_one_notation(text: str) -> None:
    with pytest.raises(ManifestError, match=r"1/8"):
        take_shard(LazySequence.of([1]), text)
