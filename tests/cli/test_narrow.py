"""A narrow terminal folds names; it cuts no number."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from mosaico_ingest import api
from mosaico_ingest.cli import plan_tables, tables

JOB = Path(__file__).resolve().parents[2] / "configs" / "quickstart.yaml"


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


def test_of_a_run(console: Console, tmp_path: Path) -> None:
    (config,) = api.compile_job(JOB)
    tables.print_report(api.run([replace(config, store=tmp_path / "store")]))
    assert {"1,000", "308.2", "500", "rejected", "written"} <= numbers(console)


def test_of_an_inspection(console: Console) -> None:
    tables.print_inspection(api.inspect_recording(JOB.parent / "quickstart" / "drive.mcap"), as_json=False)
    assert {"1,000", "100.0", "messages"} <= numbers(console)


def test_of_a_plan(console: Console) -> None:
    plan_tables.print_plan(api.plan_job(JOB), folder=JOB.parent)
    assert {"1,000", "messages"} <= numbers(console)
