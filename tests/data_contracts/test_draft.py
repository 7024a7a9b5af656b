"""Contracts drafted from recordings: the recordings fulfill them, and the limits are the documented ones."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path

import pytest
import yaml
from defective_recordings import DEFECTS, clean_drive, write_drive
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest import api
from mosaico_ingest.cli.app import main
from mosaico_ingest.errors import BagError, NothingMatched
from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.engine import lint_paths
from mosaico_ingest.report.contract import ContractResult
from mosaico_ingest.services.draft_contract import (
    MeasuredRecording,
    MeasuredTopic,
    _rounded,
    draft_contract,
    measure_recording,
)

LONGEST = 20


def results_of(recording: Path, draft: str, folder: Path) -> ContractResult:
    """Ingest a recording with a drafted contract that does not stop the run, and return the results."""
    folder.mkdir(exist_ok=True)
    (folder / "expect.yaml").write_text(draft)
    manifest = folder / "job.yaml"
    manifest.write_text(
        f"extends: expect.yaml\nbag: {{path: {recording}}}\nsequence: {{name: drafted}}\n"
        "expect: {on_failure: warn}\ntarget: {store: store}\non_error: {topic: ignore, message: ignore}\n"
    )
    findings = lint_paths([manifest], env={}).findings
    assert [str(finding) for finding in findings if finding.severity is Severity.ERROR] == []
    [report] = api.run(api.compile_job(manifest)).recordings
    assert report.contract is not None, report.error
    return report.contract


def failures(result: ContractResult) -> list[str]:
    return [one.line for one in result.results if not one.passed]


@pytest.mark.parametrize("tolerance", [0.0, 20.0])
def test_draft_of_generated_recordings_is_fulfilled_by_all_of_them(tmp_path: Path, tolerance: float) -> None:
    names = {
        "gap",
        "drifting clock",
        "slow stretch",
        "rate too high",
        "out-of-order log times",
        "frame change",
    }
    drives = [clean_drive(), *(one.change(clean_drive()) for one in DEFECTS if one.name in names)]
    paths = [write_drive(drive, tmp_path / str(number)) for number, drive in enumerate(drives)]
    draft = draft_contract([measure_recording(path) for path in paths], tolerance=tolerance)
    for number, path in enumerate(paths):
        assert failures(results_of(path, draft, tmp_path / str(number))) == []


@pytest.mark.parametrize(
    "name",
    [
        "gap",
        "frame change",
        "rate too high",
        "latency burst",
        "wrong type",
        "missing chunk CRC",
    ],
)
def test_draft_of_clean_recording_is_violated_by_defect(tmp_path: Path, name: str) -> None:
    clean = write_drive(clean_drive(), tmp_path / "clean")
    draft = draft_contract([measure_recording(clean)])
    [defect] = [one for one in DEFECTS if one.name == name]
    recording = write_drive(defect.change(clean_drive()), tmp_path / "defective")
    assert failures(results_of(recording, draft, tmp_path / "defective")) != []


def measured(rate: float, gap: int, *, count: int = 100) -> MeasuredRecording:
    topic = MeasuredTopic(
        msgtype="p/msg/A",
        count=count,
        rate_hz=rate,
        gap_ns=gap,
        latency_ns=(-2_000_000, 5_000_000),
        frames=frozenset({"a"}),
        stamps=frozenset({"monotonic"}),
        fulfilled=frozenset({"out_of_order"}),
    )
    return MeasuredRecording({"/a": topic}, 10_000_000_000, frozenset({"unreadable"}))


def test_draft_limits_are_ranges_widened_by_tolerance() -> None:
    text = draft_contract([measured(100, 12_000_000), measured(101, 15_000_000)], tolerance=10)
    assert yaml.safe_load(text)["expect"] == {
        "recording": {"duration": {"min": "9 s", "max": "11 s"}, "unreadable": 0},
        "required": ["/a"],
        "topics": {
            "/a": {
                "type": "p/msg/A",
                "rate": {"min": "90 Hz", "max": "112 Hz"},
                "gap": {"max": "16.5 ms"},
                "latency": {"min": "-2.2 ms", "max": "5.5 ms"},
                "stamps": "monotonic",
                "frame_id": ["a"],
                "out_of_order": 0,
            }
        },
    }


def test_draft_of_irregular_topic_limits_messages_instead_of_rate() -> None:
    draft = yaml.safe_load(draft_contract([measured(1, 60_000_000_000, count=50)]))
    topic = draft["expect"]["topics"]["/a"]
    assert topic["messages"] == {"min": 40}
    assert not {"rate", "gap"} & topic.keys()


def test_draft_topic_of_some_recordings_is_not_required() -> None:
    other = MeasuredRecording({}, 10_000_000_000, frozenset())
    assert "required" not in yaml.safe_load(draft_contract([measured(10, 10**8), other]))["expect"]


@given(st.floats(1e-6, 1e12), st.booleans())
def test_rounded_moves_outward_by_less_than_a_hundredth(
    value: float,
    up: bool,  # noqa: FBT001 - a drawn value
) -> None:
    written = Decimal(_rounded(value, up=up))
    assert written >= Decimal(value) if up else written <= Decimal(value)
    assert abs(written - Decimal(value)) <= Decimal(value) / 100


def test_init_expect_writes_file_and_refuses_to_replace_it(tmp_path: Path) -> None:
    paths = [str(write_drive(clean_drive(), tmp_path / name)) for name in ("a", "b")]
    out = tmp_path / "expect.yaml"
    words = ["init", "--expect", *paths, "--out", str(out), "--tolerance", "5"]
    for code in (0, 2):
        with pytest.raises(SystemExit) as leave:
            main(words)
        assert (leave.value.code or 0) == code
    assert set(yaml.safe_load(out.read_text())["expect"]["topics"]) == {"/temperature", "/ambient"}


def test_init_of_several_recordings_needs_expect(tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as leave:
        main(["init", str(tmp_path / "a.mcap"), str(tmp_path / "b.mcap")])
    assert leave.value.code == 2


def longest_recordings(corpus: Path) -> Sequence[str]:
    """Return the paths of the recordings of the index, the longest first."""
    with (corpus / "INDEX.tsv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file, delimiter="\t") if row["duration_s"]]
    return [row["path"] for row in sorted(rows, key=lambda row: -float(row["duration_s"]))]


@pytest.mark.slow
def test_draft_of_each_of_the_longest_real_recordings_is_fulfilled_by_it(
    corpus: Path, tmp_path: Path
) -> None:
    passed = 0
    for position, name in enumerate(longest_recordings(corpus)):
        try:
            recording = measure_recording(corpus / name)
        except (BagError, NothingMatched):  # the corpus has recordings that nothing can read
            continue
        draft = draft_contract([recording])
        assert failures(results_of(corpus / name, draft, tmp_path / str(position))) == [], name
        passed += 1
        if passed == LONGEST:
            return
    pytest.fail(f"only {passed} recordings can be read")
