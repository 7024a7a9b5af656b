"""Sequences whose run ended early are flagged wherever a store is listed or verified."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pytest

from mosaico_ingest.cli.app import main
from mosaico_ingest.destinations import destination_of
from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.job.values import StoreTarget
from mosaico_ingest.ontology.registry import OntologyType

Rows = Callable[..., pa.RecordBatch]


@pytest.fixture
def folder(store: Store, sink: StoreSink, rows: Rows, sample: OntologyType) -> Path:
    """A store with a complete sequence, a sequence whose run ended early, and a sequence without sessions."""
    for name in ("complete", "stopped"):
        with sink.open(name, {}) as session:
            session.topic("/t", sample, {}).write(rows([1, 2]))
            session.note_error("a topic failed", topic="/t")
            if name == "stopped":
                session.note_error("stopped before the end")
    store.create_sequence("empty", {})
    return Path(str(store.path))


EXPECTED = {"empty": "no session was finished", "stopped": "stopped before the end"}


def ingest(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int | str | None, str]:
    """Run the command line; return its exit code and standard output."""
    with pytest.raises(SystemExit) as ended:
        main(list(arguments))
    return ended.value.code, capsys.readouterr().out


def test_store_ls_json_reports_incomplete_sequences(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, output = ingest(capsys, "store", "ls", "--store", str(folder), "--json")
    listed = {each["name"]: each["incomplete"] for each in json.loads(output)}
    assert (code, listed) == (0, {"complete": None, **EXPECTED})


def test_store_ls_text_marks_incomplete_sequences(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, output = ingest(capsys, "store", "ls", "--store", str(folder))
    assert [line for line in output.splitlines() if "incomplete" in line] == [
        f"{name}: incomplete: {reason}" for name, reason in EXPECTED.items()
    ]


def test_verify_with_incomplete_sequence_fails(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, output = ingest(capsys, "verify", "--store", str(folder), "--json")
    document = json.loads(output)
    assert (code, document["problems"], document["incomplete"]) == (5, [], EXPECTED)


def test_verify_of_complete_sequence_succeeds(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _ = ingest(capsys, "verify", "complete", "--store", str(folder))
    assert code == 0


def test_store_destination_reports_sequence_as_incomplete(folder: Path) -> None:
    destination = destination_of(StoreTarget(folder))
    names = ("complete", "empty", "stopped")
    sequences = {name: found.complete for name in names if (found := destination.find(name))}
    assert sequences == {"complete": True, "empty": False, "stopped": False}
