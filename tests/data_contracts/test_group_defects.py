"""Defects of several recordings of one run: a missing file, a late start, and a missing interval."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from defective_recordings import SECOND, Drive, clean_drive, write_drive

from mosaico_ingest import api
from mosaico_ingest.report.events import RunFinished

CONTRACT = 'expect: {group: {files: ["*_front.mcap", "*_rear.mcap"], starts: {within: 5 s}, ends: {within: 5 s}, gap: {max: 1 s}}}\n'


def shifted(name: str, seconds: float) -> Drive:
    """Return the clean drive under another name, with log times that are later by some seconds."""
    offset_ns = int(seconds * SECOND)
    messages = tuple(replace(one, log_ns=one.log_ns + offset_ns) for one in clean_drive().messages)
    return replace(clean_drive(), name=name, messages=messages)


def _key_at(line: str, column: int) -> str:
    """Return the key of the section `group` that a column of the manifest belongs to."""
    keys = [(line.index(f"{key}:"), key) for key in ("files", "starts", "ends", "gap")]
    return max(pair for pair in keys if pair[0] < column)[1]


@pytest.mark.parametrize(
    ("drives", "keys"),
    [
        ({"a_front.mcap": 0, "a_rear.mcap": 1}, set[str]()),
        ({"a_front.mcap": 0}, {"files"}),
        ({"a_front.mcap": 0, "a_rear.mcap": 8}, {"starts", "ends"}),
        ({"a_front.mcap": 0, "a_rear.mcap": 30}, {"starts", "ends", "gap"}),
    ],
    ids=["clean", "missing file", "late start", "missing interval"],
)
def test_group_defect_is_caught_and_no_recording_is_stored(
    tmp_path: Path, drives: dict[str, float], keys: set[str]
) -> None:
    for name, seconds in drives.items():
        write_drive(shifted(name, seconds), tmp_path)
    manifest = tmp_path / "job.yaml"
    manifest.write_text(f'bag: {{path: "*.mcap"}}\ntarget: {{store: store}}\n{CONTRACT}')
    ends: list[RunFinished] = []
    report = api.run(
        api.compile_job(manifest),
        observe=lambda _, event: ends.append(event) if isinstance(event, RunFinished) else None,
    )
    spans = {finding.span for end in ends for finding in end.findings if finding.span is not None}
    lines = manifest.read_text().splitlines()
    failed = {_key_at(lines[span.line - 1], span.column) for span in spans}
    assert (report.exit_code, failed) == (6 if keys else 0, keys)
    assert any((tmp_path / "store").glob("segments/*")) is not bool(keys)
