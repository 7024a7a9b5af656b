"""Each generated defect is caught by its contract, and nothing is stored; its clean twin passes and is stored."""

from __future__ import annotations

from pathlib import Path

import pytest
from defective_recordings import DEFECTS, Defect, Drive, clean_drive, write_drive

from mosaico_ingest import api
from mosaico_ingest.report.events import RunFinished
from mosaico_ingest.report.recording import Report
from mosaico_ingest.services.schemas import write_lock

SCHEMA = '{"properties": {"vehicle": {"pattern": "^r[0-9]+$"}}, "required": ["vehicle"]}'


def ingest(drive: Drive, folder: Path, contract: str, *, lock: bool = False) -> tuple[Report, set[str]]:
    """Ingest a drive; return its report and the last keys of failed expectations, or the rules of its error."""
    recording = write_drive(drive, folder)
    (folder / "vehicle.schema.json").write_text(SCHEMA)
    manifest = folder / "job.yaml"
    manifest.write_text(f"bag: {{path: {recording.name}}}\ntarget: {{store: store}}\n{contract}")
    if lock:
        write_lock(manifest, api.compile_job(manifest, locked=False))
    ends: list[RunFinished] = []
    report = api.run(
        api.compile_job(manifest),
        observe=lambda _, event: ends.append(event) if isinstance(event, RunFinished) else None,
    )
    [recorded] = report.recordings
    failed = recorded.contract.errors if recorded.contract is not None else ()
    names = {result.expectation.removesuffix(".0").rpartition(".")[2] for result in failed}
    rules = {finding.rule for finding in ends[0].findings}
    return recorded, names or rules


def stored(folder: Path) -> bool:
    return any((folder / "store").glob("segments/*"))


@pytest.mark.parametrize("defect", DEFECTS, ids=lambda defect: defect.name)
def test_defect_is_caught_by_its_contract_and_clean_twin_passes(defect: Defect, tmp_path: Path) -> None:
    is_locked = "locked" in defect.contract
    clean = defect.clean(clean_drive())
    passed, names = ingest(clean, tmp_path / "clean", defect.contract, lock=is_locked)
    assert (passed.exit_code, names) == (0, set())
    assert stored(tmp_path / "clean")
    if is_locked:
        (tmp_path / "defective").mkdir()
        lock = (tmp_path / "clean" / "job.lock.json").read_text()
        (tmp_path / "defective" / "job.lock.json").write_text(lock)
    failed, names = ingest(defect.change(clean), tmp_path / "defective", defect.contract)
    assert (failed.exit_code, names) == (6, set(defect.keys))
    assert not stored(tmp_path / "defective")
