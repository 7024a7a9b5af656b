"""A narrow terminal folds names and cuts no number; a batch says why messages were rejected."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from mosaico_ingest import api
from mosaico_ingest.cli import plan as plan_tables
from mosaico_ingest.cli import report as tables
from mosaico_ingest.cli import store as store_tables
from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.findings import Stage
from mosaico_ingest.ontology.registry import ontology_type
from mosaico_ingest.report.model import Rejection, RunReport

JOB = Path(__file__).resolve().parents[2] / "configs" / "quickstart.yaml"
DRIVE = JOB.parent / "quickstart" / "drive.mcap"


@pytest.fixture
def console(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Console:
    """Return a terminal of 60 columns, whose text is in `file`."""
    monkeypatch.chdir(tmp_path)
    narrow = Console(file=io.StringIO(), width=60)
    for module in (tables, plan_tables):
        monkeypatch.setattr(module, "open_console", lambda: narrow)
    return narrow


def numbers(console: Console) -> set[str]:
    assert isinstance(console.file, io.StringIO)
    text = console.file.getvalue()
    assert "…" not in text
    return set(text.split())


def run_quickstart(folder: Path) -> RunReport:
    (config,) = api.compile_job(JOB)  # whose store is in the checkout
    return api.run([replace(config, store=folder / "store")])


def test_of_a_run(console: Console, tmp_path: Path) -> None:
    tables.print_report(run_quickstart(tmp_path))
    assert {"1,000", "308.2", "500", "rejected", "written"} <= numbers(console)


def test_of_an_inspection(console: Console) -> None:
    tables.print_inspection(api.inspect_recording(DRIVE), as_json=False)
    assert {"1,000", "100.0", "messages"} <= numbers(console)


def test_of_a_plan(console: Console) -> None:
    plan_tables.print_plan(api.plan_job(JOB), folder=JOB.parent)
    assert {"1,000", "messages"} <= numbers(console)


def test_a_batch_says_why_messages_were_rejected_up_to_a_point(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_quickstart(tmp_path)
    (drive,) = run.recordings
    why = Rejection(
        stage=Stage.DECODE,
        rule="truncated",
        count=3,
        reason="4 bytes needed",
        first_log_time_ns=0,
        first_offset=0,
    )
    imu = drive.topics[0].model_copy(update={"rejections": (why,)})
    bad = drive.model_copy(update={"topics": (imu,)})
    tables.print_report(run.model_copy(update={"recordings": (bad,) * 25}))
    said = capsys.readouterr().out
    assert said.count("quickstart_drive: /imu: 3 rejected [truncated]: 4 bytes needed\n") == 20
    assert "… and 5 more reasons, which --report FILE keeps\n" in said


def test_what_is_stored_of_a_part_is_held_against_that_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "job.yaml").write_text(f"bag: {{path: {DRIVE}, time: {{end: +1s}}}}\n")
    tables.print_report(api.run(api.compile_job(tmp_path / "job.yaml")))
    assert " of messages stored in " in capsys.readouterr().out
    (tmp_path / "job.yaml").write_text(f"bag: {{path: {DRIVE}}}\nsequence: {{name: all}}\n")
    tables.print_report(api.run(api.compile_job(tmp_path / "job.yaml")))
    assert " messages written, 497.3 kB stored in " in capsys.readouterr().out


def test_the_list_says_which_sequence_is_not_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sink = StoreSink(Store.open(tmp_path))
    for name in ("whole", "torn"):
        with sink.open(name, {}) as session:
            session.topic("/t", ontology_type("String"), {})
            if name == "torn":
                session.note_error("the disk is full")
    store_tables.print_sequences(Store.open(tmp_path).sequences(), as_json=False)
    assert capsys.readouterr().out.splitlines()[-1:] == ["torn: incomplete: the disk is full"]
