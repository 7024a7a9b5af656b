"""Contracts of complete runs: committed sequences, exit codes, and the reports of check and plan."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mosaico_ingest import api
from mosaico_ingest.cli.app import main
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import ManifestError
from mosaico_ingest.report.parts import ContractResult, Outcome
from mosaico_ingest.report.recording import Report
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.recording import open_recording

QUICKSTART = Path(__file__).parents[2] / "configs" / "quickstart"
HEAD = """\
bag: {path: drive.mcap}
sequence: {name: drive}
target: {store: store}
topics: ["/imu", "/gps/fix", "/odom"]
expect:
"""
FAILING = HEAD + "  topics:\n    /imu:\n      rate: {min: 150 Hz}\n      fields: {acceleration.z: {max: 9}}\n"
PASSING = (
    HEAD + "  topics:\n    /imu:\n      rate: {min: 95 Hz}\n      fields: {norm(orientation): {max: 1.1}}\n"
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    shutil.copy(QUICKSTART / "drive.mcap", tmp_path)
    return tmp_path


def write(folder: Path, text: str) -> Path:
    path = folder / "job.yaml"
    path.write_text(text)
    return path


def run(folder: Path, text: str) -> Report:
    (report,) = api.run(api.compile_job(write(folder, text))).recordings
    return report


def names(folder: Path) -> tuple[str, ...]:
    store = Store.find(folder / "store")
    return () if store is None else store.names()


def outcomes(contract: ContractResult | None) -> list[tuple[str, str | None, str, Any]]:
    assert contract is not None
    return [(one.expectation, one.topic, one.outcome.value, one.measured) for one in contract.results]


def exit_code(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(arguments)
    return int(end.value.code or 0)


def test_run_failed_expectation_commits_nothing_and_exits_with_6(folder: Path) -> None:
    report = run(folder, FAILING)
    assert (report.status.value, report.exit_code) == ("failed", 6)
    assert names(folder) == ()
    assert list((folder / "store").rglob("*.parquet")) == []
    assert report.contract is not None
    failed = {one.key: one for one in report.contract.errors}
    assert set(failed) == {"rate", "fields.acceleration.z.max"}
    rate, value = failed["rate"], failed["fields.acceleration.z.max"]
    assert rate.measured == pytest.approx(100.0)
    assert rate.location is not None
    assert (rate.location.line, rate.location.column) == (8, 7)
    assert (value.violations, value.worst and value.worst.value) == (1000, pytest.approx(9.81))
    assert value.first is not None
    assert (value.first.index, value.first.log_time_ns) == (0, 1_767_225_600_000_050_000)


def test_run_passing_contract_stores_results_in_metadata(folder: Path) -> None:
    report = run(folder, PASSING)
    assert report.exit_code == 0
    metadata = Store.open(folder / "store").sequence("drive").metadata
    contract = metadata["mosaico_ingest"]["contract"]
    assert (contract["passed"], contract["expectations"], contract["failed"]) == (True, 2, 0)
    assert contract["measured"]["imu"]["rate"] == pytest.approx(100.0)


def test_run_with_warn_commits_and_notes_the_failure(folder: Path) -> None:
    report = run(folder, FAILING + "  on_failure: warn\n")
    assert (report.exit_code, names(folder)) == (0, ("drive",))
    assert sum("expectation-failed" in finding for finding in report.findings) == 2
    metadata = Store.open(folder / "store").sequence("drive").metadata
    assert metadata["mosaico_ingest"]["contract"]["failed"] == 2


def test_run_with_divert_commits_under_another_name(folder: Path) -> None:
    for _ in range(2):  # the second run replaces what the first one diverted
        report = run(folder, FAILING + "  on_failure: divert\n")
        assert (report.status.value, report.exit_code) == ("diverted", 6)
        assert report.contract is not None
        assert report.contract.stored_as == "drive__failed"
        assert names(folder) == ("drive__failed",)
    folders = {path.parent.parent.name for path in (folder / "store" / "segments").rglob("imu/*.parquet")}
    assert folders == {"drive__failed"}
    assert run(folder, PASSING).exit_code == 0
    assert names(folder) == ("drive", "drive__failed")


def test_run_warning_severity_does_not_fail(folder: Path) -> None:
    report = run(
        folder,
        FAILING.replace("{min: 150 Hz}", "{min: 150 Hz, severity: warning}").replace("max: 9", "max: 10"),
    )
    assert report.exit_code == 0
    assert report.contract is not None
    assert [one.key for one in report.contract.warnings] == ["rate"]


def test_run_replace_keeps_stored_sequence_if_contract_fails(folder: Path) -> None:
    assert run(folder, PASSING).exit_code == 0
    before = Store.open(folder / "store").sequence("drive").topics[0].checksum
    assert run(folder, FAILING.replace("name: drive", "name: drive, if_exists: replace")).exit_code == 6
    assert Store.open(folder / "store").sequence("drive").topics[0].checksum == before


def test_run_in_processes_reports_contract_of_each_recording(folder: Path) -> None:
    shutil.copy(folder / "drive.mcap", folder / "other.mcap")
    text = FAILING.replace("drive.mcap", '"*.mcap"').replace("name: drive", 'name: "{stem}"')
    reports = api.run(api.compile_job(write(folder, text + "run: {jobs: 2}\n"))).recordings
    assert [report.exit_code for report in reports] == [6, 6]
    assert all(report.contract is not None and len(report.contract.errors) == 2 for report in reports)
    assert names(folder) == ()


EVERYTHING = (
    HEAD
    + """\
  recording: {duration: {min: 5s}, messages: {min: 1}, unreadable: 0, chunk_crcs: {present: false}, metadata_counts: {}}
  required: [/imu, /missing]
  forbidden: [/odom]
  topics:
    "*":
      rate: {min: 1 Hz}
      sliding_rate: {window: 2s, min: 1 Hz, max: 99 Hz}
      gap: {max: 50 ms}
      gaps: {over: 2 periods, max_share: 5%}
      messages: {min: 100}
      rejected: 0
      latency: {max: 200 ms}
      stamps: [monotonic, unique]
      frame_id: [imu_link]
      sequence_numbers: {missing: 0}
      out_of_order: 0
      coverage: {min: 99%, gap: 1s}
      start: {within: 1ms}
      end: {within: 1ms, of: /imu}
    /imu:
      type: [sensor_msgs/msg/Imu, std_msgs/msg/Int64]
      fields:
        linear_acceleration.z: {between: [-40, 40], finite: true, nulls: 0, mean: {min: 10}, std: {max: 1}}
        angular_velocity_covariance[]: {min: 1, equals: 0}
        header.frame_id: {one_of: [a, b], unchanged: {max: 1s}}
"""
)


def test_check_results_equal_those_of_a_run(folder: Path) -> None:
    report = run(folder, EVERYTHING + "  on_failure: warn\n")
    (checked,) = api.check_recordings(folder / "job.yaml")
    assert outcomes(checked.contract) == outcomes(report.contract)
    assert checked.exit_code == 6
    assert {one.outcome for one in checked.contract.results} == set(Outcome) if checked.contract else False


def test_check_times_from_index_equal_times_of_messages(folder: Path) -> None:
    with open_recording(folder / "drive.mcap", resolve=TypeResolver()) as recording:
        ids = [connection.id for connection in recording.connections]
        times = recording.index_times(ids, start_ns=1_767_225_601_000_000_000)
        assert times is not None
        for key in ids:
            blocks = recording.message_blocks([key], start_ns=1_767_225_601_000_000_000)
            expected = np.sort(np.concatenate([block.log_times for block in blocks]))
            assert times[key].tolist() == expected.tolist()


def test_check_command_with_expect_checks_default_store(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = PASSING.replace("target: {store: store}\n", "")
    monkeypatch.chdir(folder)
    run(folder, text)
    assert exit_code("check", "drive", "--expect", "job.yaml") == 0
    assert "drive: 2 expectations: 2 passed" in capsys.readouterr().out
    assert exit_code("check", "drive", "--store", "mosaico") == 2


def test_check_command_exit_codes_and_json(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("check", str(write(folder, FAILING))) == 6
    assert "expectation-failed" in capsys.readouterr().out
    assert exit_code("check", str(write(folder, PASSING)), "--json") == 0
    (document,) = json.loads(capsys.readouterr().out)
    assert document["contract"]["passed"] is True
    assert exit_code("check", str(write(folder, "bag: {path: drive.mcap}\n"))) == 2
    assert names(folder) == ()


def test_plan_reports_what_index_and_sample_reveal(folder: Path) -> None:
    document = api.plan_job(write(folder, FAILING))
    (recording,) = document.recordings
    assert recording.contract is not None
    assert {one.key for one in recording.contract.errors} == {"rate", "fields.acceleration.z.max"}
    assert document.exit_code == 6
    assert api.plan_job(write(folder, FAILING + "  on_failure: warn\n")).exit_code == 0
    assert api.plan_job(write(folder, PASSING)).exit_code == 0


def test_stored_sequence_is_checked_over_columns_and_message_fields(folder: Path) -> None:
    run(folder, PASSING)
    (folder / "expect.yaml").write_text(
        "expect:\n  topics:\n    /imu:\n      rate: {min: 150 Hz}\n      latency: {max: 1s}\n      frame_id: imu\n"
        "      rejected: 0\n      fields: {acceleration.z: {max: 9}, linear_acceleration.z: {max: 9}}\n"
    )
    checked = api.check_sequence(str(folder / "store"), "drive", folder / "expect.yaml")
    results = {one.key: one.outcome.value for one in checked.contract.results} if checked.contract else {}
    assert results == {
        "rate": "failed",
        "latency": "passed",
        "frame_id": "failed",
        "rejected": "skipped",
        "fields.acceleration.z.max": "failed",
        "fields.linear_acceleration.z.max": "failed",
    }
    assert checked.exit_code == 6


def test_unknown_name_is_an_error_with_suggestion_in_lint_and_plan(folder: Path) -> None:
    path = write(folder, PASSING.replace("norm(orientation)", "linear_aceleration.z"))
    with pytest.raises(ManifestError) as error:
        api.plan_job(path)
    (finding,) = error.value.findings
    assert (finding.rule, finding.span and (finding.span.line, finding.span.column)) == (
        "unknown-field",
        (9, 16),
    )
    assert finding.help is not None
    assert "did you mean 'linear_acceleration'?" in finding.help
    assert exit_code("lint", str(write(folder, path.read_text() + "      type: sensor_msgs/msg/Imu\n"))) == 12


def test_group_missing_file_fails_every_recording_before_it_is_read(folder: Path) -> None:
    shutil.copy(folder / "drive.mcap", folder / "a_lidar.mcap")
    text = """\
bag: {path: "*.mcap"}
sequence: {name: "{stem}"}
target: {store: store}
expect:
  group: {files: ["*_lidar.mcap", "*_gps.mcap"], starts: {within: 5s}, ends: {within: 5s}, gap: {max: 1s}}
"""
    reports = api.run(api.compile_job(write(folder, text))).recordings
    assert [(report.exit_code, report.totals.read) for report in reports] == [(6, 0), (6, 0)]
    assert names(folder) == ()
    complete = text.replace(', "*_gps.mcap"', "")
    assert [report.exit_code for report in api.run(api.compile_job(write(folder, complete))).recordings] == [
        0,
        0,
    ]
