"""`--junit` and `--sarif` of `run` and `plan`."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from metadata_files import write

from mosaico_ingest.cli.app import main
from mosaico_ingest.cli.check import CheckedRecording, CiFiles
from mosaico_ingest.findings import Severity
from mosaico_ingest.report.parts import ContractResult, ExpectationResult, Location, Outcome

LOCATION = Location(file="job.yaml", line=7, column=5, end_line=7, end_column=9)


def result(name: str, outcome: Outcome, severity: Severity = Severity.ERROR) -> ExpectationResult:
    return ExpectationResult(
        expectation=f"expect.topics./imu.{name}",
        severity=severity,
        outcome=outcome,
        text=f"the {name}",
        topic="/imu",
        location=LOCATION,
    )


CONTRACT = ContractResult(
    on_failure="fail",
    results=(
        result("rate", Outcome.PASSED),
        result("gap", Outcome.FAILED),
        result("latency", Outcome.FAILED, Severity.WARNING),
        result("stamps", Outcome.SKIPPED),
    ),
)


def exit_code(*words: str) -> int:
    with pytest.raises(SystemExit) as leave:
        main(list(words))
    return int(leave.value.code or 0)


def cases(path: Path) -> list[tuple[str, str, str | None, str | None]]:
    """Return the name, the outcome, the file name and the line of each test case."""
    root = ET.parse(path).getroot()  # noqa: S314 - our own text
    return [
        (
            str(case.get("name")),
            case[0].tag if len(case) else "passed",
            None if case.get("file") is None else Path(str(case.get("file"))).name,
            case.get("line"),
        )
        for case in root.iter("testcase")
    ]


def test_junit_has_a_test_case_per_expectation_with_location_of_its_key(tmp_path: Path) -> None:
    with CiFiles(tmp_path / "a.xml", None) as files:
        files.add(CheckedRecording("drive", CONTRACT))
    assert cases(tmp_path / "a.xml") == [
        ("expect.topics./imu.rate", "passed", "job.yaml", "7"),
        ("expect.topics./imu.gap", "failure", "job.yaml", "7"),
        ("expect.topics./imu.latency", "failure", "job.yaml", "7"),
        ("expect.topics./imu.stamps", "skipped", "job.yaml", "7"),
    ]
    suite = ET.parse(tmp_path / "a.xml").getroot()[0]  # noqa: S314 - our own text
    assert suite.attrib == {"name": "drive", "tests": "4", "failures": "2", "skipped": "1"}
    assert [failure.get("type") for failure in suite.iter("failure")] == ["error", "warning"]


def test_sarif_has_a_result_per_failed_expectation_at_its_key(tmp_path: Path) -> None:
    with CiFiles(None, tmp_path / "a.sarif") as files:
        files.add(CheckedRecording("drive", CONTRACT))
    [run] = json.loads((tmp_path / "a.sarif").read_text())["runs"]
    assert [(one["ruleId"], one["level"]) for one in run["results"]] == [
        ("expectation-failed", "error"),
        ("expectation-failed", "warning"),
        ("expectation-skipped", "note"),
    ]
    place = run["results"][0]["locations"][0]["physicalLocation"]
    assert (place["artifactLocation"]["uri"], place["region"]["startLine"]) == ("job.yaml", 7)


def test_run_and_plan_write_metadata_violation_as_failed_test(tmp_path: Path) -> None:
    write(tmp_path / "r1.mcap")
    (tmp_path / "schema.json").write_text('{"required": ["vehicle"]}')
    manifest = tmp_path / "job.yaml"
    manifest.write_text(
        f"bag: {{path: r1.mcap}}\ntarget: {{store: {tmp_path}/s}}\nsequence:\n  metadata_schema: schema.json\n"
    )
    for command in (["run", "-q"], ["plan"]):
        junit, sarif = tmp_path / f"{command[0]}.xml", tmp_path / f"{command[0]}.sarif"
        assert exit_code(*command, str(manifest), "--junit", str(junit), "--sarif", str(sarif)) == 6
        [case] = cases(junit)
        assert case[0].startswith("metadata-schema: ")
        assert case[1:] == ("failure", "job.yaml", "3")
        [actual] = json.loads(sarif.read_text())["runs"][0]["results"]
        assert actual["ruleId"] == "metadata-schema"


def test_run_without_contract_writes_one_passed_test_per_recording(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write(tmp_path / f"{name}.mcap")
    manifest = tmp_path / "job.yaml"
    manifest.write_text(f'bag: {{path: "*.mcap"}}\ntarget: {{store: {tmp_path}/s}}\n')
    assert exit_code("run", "-q", str(manifest), "--junit", str(tmp_path / "a.xml")) == 0
    assert cases(tmp_path / "a.xml") == [("ingest", "passed", None, None)] * 2


def test_run_with_failed_recording_writes_its_error(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"nothing")
    manifest = tmp_path / "job.yaml"
    manifest.write_text(f"bag: {{path: a.mcap}}\ntarget: {{store: {tmp_path}/s}}\n")
    assert exit_code("run", "-q", str(manifest), "--junit", str(tmp_path / "a.xml")) == 1
    [(name, outcome, _, _)] = cases(tmp_path / "a.xml")
    assert (name.partition(":")[0], outcome) == ("run-failed", "failure")


def test_run_with_failed_group_writes_failed_tests(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap")
    manifest = tmp_path / "job.yaml"
    manifest.write_text(
        f"bag: {{path: '*.mcap'}}\ntarget: {{store: {tmp_path}/s}}\nexpect: {{group: {{files: [b.mcap]}}}}\n"
    )
    assert exit_code("run", "-q", str(manifest), "--junit", str(tmp_path / "a.xml")) == 6
    [(name, outcome, file, line)] = cases(tmp_path / "a.xml")
    assert (name.partition(":")[0], outcome, file, line) == ("expectation-failed", "failure", "job.yaml", "3")
