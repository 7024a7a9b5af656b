"""The steps of a run account for all of its time."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from mosaico_ingest.cli.app import command_line
from mosaico_ingest.report.parts import Step, Stopwatch
from mosaico_ingest.report.run import read_report

DRIVE = Path(__file__).resolve().parents[2] / "configs" / "quickstart" / "drive.mcap"


def test_stopwatch_laps_add_up_to_elapsed_time() -> None:
    watch = Stopwatch()
    for step in (Step.READ, Step.DECODE, Step.READ, Step.COMMIT):
        watch.lap(step)
    before = sum(watch.seconds.values())
    assert before <= watch.elapsed_s
    watch.add(Step.WRITE, 5.0)
    assert sum(watch.seconds.values()) == pytest.approx(before + 5.0)


def test_report_steps_add_up_to_duration(tmp_path: Path) -> None:
    (tmp_path / "job.yaml").write_text(
        f"bag: {{path: {DRIVE}}}\ntopics: [/imu, /odom]\ntarget: {{store: s}}\n"
    )
    run = tmp_path / "run.json"
    result = CliRunner().invoke(
        command_line(), ["run", str(tmp_path / "job.yaml"), "--report", str(run), "-q"]
    )
    assert result.exit_code == 0, result.output
    report = read_report(run)
    one = report.recordings[0]
    steps = one.steps.model_dump()
    assert min(steps.values()) > 0
    assert sum(steps.values()) - one.steps.write == pytest.approx(one.duration_s, abs=0.25)
    assert report.manifests[0].path == str(tmp_path / "job.yaml")
    assert "topics: [/imu, /odom]" in report.manifests[0].text
